"""``bench latency``: the sums, and one short run of the real processes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.common.errors import InputError
from services.evaluate.bench_latency import measure
from services.evaluate.live_set import read_frames
from services.evaluate.passages import Passage, Passages, figures_of, latencies_ms, stages_ms

MS = 1_000_000
FRAMES = 45
CAMERA = {"width": 320, "height": 240, "fx": 250.0, "fy": 250.0, "cx": 159.5, "cy": 119.5, "depth_scale": 1000.0}


def _passages() -> Passages:
    seen = Passages()
    for k in range(100):
        stamp = 10_000 * MS + k * 66 * MS
        seen.by_stamp[stamp] = Passage(
            frame_ns=stamp + 5 * MS, pose_ns=stamp + 30 * MS, target_ns=stamp + (33 + (k == 99) * 60) * MS, track_ms=20.0,
            located=True, measured=k % 2 == 0,
        )  # fmt: skip
    return seen


def test_stages_add_up_to_the_latency() -> None:
    seen = _passages()
    figures = figures_of(seen)
    assert figures["latency_ms_p50"] == pytest.approx(33.0)
    assert figures["latency_ms_max"] == pytest.approx(93.0)
    assert figures["measured"] == 50
    assert np.sum([np.array(ms) for ms in stages_ms(seen).values()], axis=0) == pytest.approx(latencies_ms(seen))


def test_a_frame_without_answer_is_no_latency_and_no_frames_are_told() -> None:
    seen = _passages()
    seen.by_stamp[99 * MS] = Passage(frame_ns=104 * MS)
    assert len(latencies_ms(seen)) == 100
    with pytest.raises(InputError, match="no frame was answered"):
        figures_of(Passages())


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    """A textured wall that passes by, three seconds of it."""
    import cv2

    folder = tmp_path / "wall"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    rng = np.random.default_rng(5)
    texture = cv2.resize(rng.integers(0, 255, (60, 120, 3), dtype=np.uint8), (640, 240), interpolation=cv2.INTER_CUBIC)
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for i in range(FRAMES):
        stamp = f"{100.0 + i / 15.0:.6f}"
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), texture[:, 2 * i : 2 * i + 320])
        cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), np.full((240, 320), 2000, dtype=np.uint16))
        for name, lines in lists.items():
            lines.append(f"{stamp} {name}/{stamp}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.slow  # six processes; they compile their kernels when the cache is cold
def test_every_frame_of_a_recording_is_answered(wall: Path) -> None:
    figures = figures_of(measure(read_frames(wall, FRAMES), 15.0))
    assert figures["frames"] == FRAMES
    assert figures["answered"] >= FRAMES - 3, "a busy machine may drop a frame"
    assert 0.0 < figures["latency_ms_p50"] < 5000.0


def test_a_recording_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        read_frames(tmp_path / "nowhere", 5)
