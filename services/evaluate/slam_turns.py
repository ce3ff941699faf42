"""Simulated turns on the spot for slam: rendered once, kept as arrays, run through the core, judged against the truth."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.config import TreedockConfig
from services.common.geometry import inverse, log_rotation, orthonormal, pose
from services.evaluate.ate import Trajectory, ate, read_trajectory
from services.evaluate.bench import BenchOptions, code_version
from services.evaluate.bench_catalogue import _SIMULATOR
from services.slam.config import SlamConfig
from services.slam.results import TrackResult
from services.slam.slam import Slam

F64 = NDArray[np.float64]

TURN_FRAMES = 330
"""At 15 Hz: rest, rise, the whole turn of the reference path, and the beginning of the turn towards the tree."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame as slam gets it, and the truth."""

    stamp_ns: int
    grey: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    accel_camera: F64 | None
    T_map_camera: F64


@dataclass(frozen=True, slots=True)
class Turn:
    """A rendered sequence in memory; depth stays in the camera's whole units."""

    intrinsics: Intrinsics
    stamp_ns: tuple[int, ...]
    grey: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    accel_camera: tuple[F64 | None, ...]
    truth: Trajectory

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def shot(self, index: int) -> Shot:
        """Return one frame."""
        depth_m = self.depth[index].astype(np.float32) / np.float32(self.intrinsics.depth_scale)
        return Shot(
            self.stamp_ns[index], self.grey[index], depth_m, self.accel_camera[index], self.truth.poses[index]
        )  # fmt: skip


@contextmanager
def rendered_turn(seed: int, options: BenchOptions) -> Iterator[Path]:
    """Give the folder of a turn in the scene of ``seed``: one kept from an earlier call, or rendered now at half size."""
    from services.simulator.catalogue import random_scene
    from services.simulator.write import write_sequence

    store = options.out / "slam-turns"
    kept = store / f"turn-{seed}-{code_version(_SIMULATOR)}"
    if not kept.is_dir():
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"turn-{seed}-", dir=store) as folder:
            sequence = Path(folder) / kept.name
            write_sequence(random_scene(seed), sequence, frames=TURN_FRAMES, reduced=True, seed=seed)
            sequence.rename(kept)
    try:
        yield kept
    finally:
        if not options.keep_sequences:
            shutil.rmtree(kept)


def read_turn(folder: Path) -> Turn:
    """Read a rendered sequence into memory."""
    import cv2

    from services.camera.codecs import decode_colour, decode_depth_raw
    from services.camera.sources import BadFrame, open_recording

    stamps, grey, depth, accel, intrinsics = [], [], [], [], None
    for frame in open_recording(folder, TreedockConfig().camera):
        assert not isinstance(frame, BadFrame)
        intrinsics = frame.intrinsics
        stamps.append(frame.stamp_ns)
        grey.append(cv2.cvtColor(decode_colour(frame), cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False))
        depth.append(decode_depth_raw(frame))
        accel.append(None if frame.accel_camera is None else np.array(frame.accel_camera))
    assert intrinsics is not None
    truth = read_trajectory(folder / "groundtruth.txt")
    return Turn(intrinsics, tuple(stamps), np.stack(grey), np.stack(depth), tuple(accel), truth)


@dataclass(frozen=True, slots=True)
class Heard:
    """What slam said of one frame, relative to the map's first keyframe: free of later turns of the map as a whole."""

    result: TrackResult
    T_first_camera: F64 | None
    track_ms: float


def listen(slam: Slam, shots: Iterator[Shot]) -> list[Heard]:
    """Run slam over frames."""
    heard = []
    for shot in shots:
        begin = time.perf_counter()
        result = slam.track(shot.stamp_ns, shot.grey, shot.depth_m, shot.accel_camera)
        ms = (time.perf_counter() - begin) * 1e3
        T = None
        if result.T_map_camera is not None:
            T = inverse(slam.mapping.keyframe_pose(0)) @ result.T_map_camera
        heard.append(Heard(result, T, ms))
    return heard


def mean_alignment(mine: Sequence[F64], true: Sequence[F64]) -> F64:
    """Return the transform (4, 4) that takes ``mine`` to ``true``: mean rotation, then mean position.

    On a turn on the spot the positions alone say nothing of the yaw, so that the rotations have to.
    """
    a, b = np.stack(mine), np.stack(true)
    R = orthonormal(np.einsum("nij,nkj->ik", b[:, :3, :3], a[:, :3, :3]) / len(a))
    return pose(R, b[:, :3, 3].mean(axis=0) - R @ a[:, :3, 3].mean(axis=0))


def pose_errors(mine: Sequence[F64], true: Sequence[F64], A: F64) -> F64:
    """Return (N, 6) position (m) and rotation (rad) errors of ``A mine`` against ``true``, in the truth's axes."""
    rows = []
    for m, t in zip(mine, true, strict=True):
        T = A @ m
        rows.append(np.concatenate([T[:3, 3] - t[:3, 3], log_rotation(T[:3, :3] @ t[:3, :3].T)]))
    return np.array(rows)


def run_turn(seed: int, turn: Turn, config: SlamConfig) -> dict[str, Any]:
    """Run slam over a whole turn and return its row: figures by name."""
    slam = Slam(turn.intrinsics, config)
    heard = listen(slam, (turn.shot(k) for k in range(len(turn))))
    slam.polish()
    final = slam.final_trajectory()
    end = ate(Trajectory(np.array([s for s, _ in final]), np.stack([T for _, T in final])), turn.truth)
    tracked = [k for k, h in enumerate(heard) if h.T_first_camera is not None]
    online = [T for h in heard if (T := h.T_first_camera) is not None]
    true = [turn.truth.poses[k] for k in tracked]
    errors = pose_errors(online, true, mean_alignment(online, true))
    placed = [T for _, T in final]
    rotation = np.degrees(np.linalg.norm(pose_errors(placed, true, mean_alignment(placed, true))[:, 3:], axis=1))
    loops = [k for k, h in enumerate(heard) if h.result.graph is not None and h.result.graph.reason == "loop"]
    after = [i for i, k in enumerate(tracked) if not loops or k >= loops[0]]  # no loop: the whole way counts
    return {
        "seed": seed,
        "frames": len(turn),
        "tracked": len(tracked),
        "ate_m": round(end.rmse_m, 5),
        "online_m": round(float(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))), 5),
        "loop_frame": loops[0] if loops else -1,
        "rot_after_loop_deg": round(float(_after_loop(online, true, after)), 4),
        "rot_final_deg": round(float(rotation.max()), 4),
        "rot_first_deg": round(end.rotation_deg_max, 4),
        "tilt_deg": round(_tilt(heard, turn), 4),
        "up_sigma_deg": round(float(np.degrees(heard[-1].result.up_sigma_rad)), 4),
        "resets": int(slam.reset_counter),
        "nees": [round(float(v), 4) for v in nees(errors, [heard[k] for k in tracked], true)],
        "track_ms": [round(h.track_ms, 2) for h in heard[1:]],
    }


def _after_loop(online: Sequence[F64], true: Sequence[F64], after: Sequence[int]) -> float:
    """Return the largest rotation error (degrees) of the poses as published since the loop closed."""
    mine, truth = [online[i] for i in after], [true[i] for i in after]
    errors = pose_errors(mine, truth, mean_alignment(mine, truth))
    return float(np.degrees(np.linalg.norm(errors[:, 3:], axis=1).max()))


def _tilt(heard: Sequence[Heard], turn: Turn) -> float:
    """Return the angle (degrees) between the map's z and the true vertical, mean over the last ten located frames."""
    ups = []
    for h, T_true in zip(heard, turn.truth.poses, strict=True):
        if h.result.T_map_camera is not None:
            ups.append(h.result.T_map_camera[:3, :3] @ T_true[:3, :3].T @ np.array([0.0, 0.0, 1.0]))
    up = np.mean(ups[-10:], axis=0)
    return float(np.degrees(np.arccos(min(float(up[2] / np.linalg.norm(up)), 1.0))))


def nees(errors: F64, heard: Sequence[Heard], true: Sequence[F64]) -> F64:
    """Return (6,) the mean of squared error over told variance, per dimension (x y z rx ry rz), in the camera's axes.

    Errors after the mean alignment; the covariance is turned from the map's axes into the camera's, as the error is.
    The first frame, which the map is begun with, is left out.
    """
    ratios = []
    for e, h, T in zip(errors[1:], heard[1:], true[1:], strict=True):
        assert h.result.covariance is not None
        assert h.result.T_map_camera is not None
        told, mine = h.result.T_map_camera[:3, :3].T, T[:3, :3].T
        variances = [np.diag(told @ h.result.covariance[s, s] @ told.T) for s in (slice(0, 3), slice(3, 6))]
        ratios.append(np.concatenate([(mine @ e[:3]) ** 2 / variances[0], (mine @ e[3:]) ** 2 / variances[1]]))
    return np.asarray(np.mean(ratios, axis=0))
