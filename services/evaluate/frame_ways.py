"""A frame's way from the camera to slam, refiner and preview: by shared memory, and by plain TCP beside it."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.camera import RgbdFrame
from services.common.errors import InputError
from services.evaluate.live_set import READY_WITHIN_S, live_config
from services.evaluate.processes import Processes
from services.evaluate.usage import Meter

LISTENERS = ("slam", "refiner", "preview")
RATE_HZ = 30.0
_MEASURE_S, _QUICK_S = 10.0, 3.0
_SETTLE_S = 1.0
_DRAIN_S = 0.3
"""For what is on its way when the camera ends."""


@dataclass(frozen=True, slots=True)
class Way:
    """What one way of carrying frames costs."""

    shared: bool
    """By shared memory; else by the protocol alone."""
    p50_ms: float
    p99_ms: float
    camera_cores: float
    listener_cores: float
    """Of one listener, their mean."""
    router_cores: float
    lost: int
    """Frames sent, once all had found each other, that a listener did not get; of all three."""

    @property
    def cores(self) -> float:
        """All processes together."""
        return self.camera_cores + len(LISTENERS) * self.listener_cores + self.router_cores


def compare(frame: RgbdFrame, *, quick: bool) -> list[Way]:
    """Measure both ways with frames of this size, one after the other."""
    seconds = _QUICK_S if quick else _MEASURE_S
    size = (frame.intrinsics.width, frame.intrinsics.height)
    return [measure(shared=shared, size=size, seconds=seconds) for shared in (True, False)]


def measure(*, shared: bool, size: tuple[int, int], seconds: float) -> Way:
    """Send frames for a while.

    Raises:
        InputError: a process ended, or no frame came.
    """
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_client

    with tempfile.TemporaryDirectory(prefix="treedock-ways-") as name:
        folder, base = Path(name), live_config(Path(name))
        config = base.model_copy(update={"router": base.router.model_copy(update={"shared_memory": shared})})
        with Processes(config, folder) as running:
            running.start("router")
            with opened_client(config.router.endpoint, lambda: False, wait_s=60.0) as session:
                bus = Bus(session, config.uav, HealthBook())
                for role in (*LISTENERS, "camera"):
                    running.spawn(role, "services.evaluate.frame_node", role, str(running.config_file),
                                  str(_out(folder, role)), str(size[0]), str(size[1]), str(RATE_HZ))  # fmt: skip
                    running.wait(lambda role=role: bus.alive(role), READY_WITHIN_S, f"{role} to be ready")  # type: ignore[misc]
                time.sleep(_SETTLE_S)
                meter = Meter({role: running.pid(role) for role in ("router", "camera", *LISTENERS)})
                time.sleep(seconds)
                used = meter.read()
                running.stop("camera")
                time.sleep(_DRAIN_S)
                for role in LISTENERS:
                    running.stop(role)
        ages = [
            {int(seq): age for seq, age in json.loads(_out(folder, role).read_text(encoding="utf-8")).items()}
            for role in LISTENERS
        ]
        sent = int(json.loads(_out(folder, "camera").read_text(encoding="utf-8")))
    return way_of(ages, sent, {role: usage.cpu_cores for role, usage in used.items()}, shared=shared)


def _out(folder: Path, role: str) -> Path:
    return folder / f"{role}.ages.json"


def way_of(ages_ms: Sequence[Mapping[int, float]], sent: int, cores: Mapping[str, float], *, shared: bool) -> Way:
    """Return what listeners saw: the age of each frame by its number, of ``sent`` frames.

    Raises:
        InputError: a listener got none.
    """
    counts = [len(ages) for ages in ages_ms]
    if not all(counts):
        raise InputError(f"frames came to {sum(n > 0 for n in counts)} of {len(counts)} listeners only")
    together = np.concatenate([np.array(list(ages.values())) for ages in ages_ms])
    wanted = range(round(_SETTLE_S * RATE_HZ), sent)
    p50, p99 = np.quantile(together, [0.5, 0.99])
    return Way(
        shared, round(float(p50), 2), round(float(p99), 2), round(cores["camera"], 3),
        round(float(np.mean([cores[role] for role in LISTENERS])), 3), round(cores["router"], 3),
        sum(seq not in ages for ages in ages_ms for seq in wanted),
    )  # fmt: skip


def table_of(ways: Sequence[Way]) -> str:
    """Return the comparison as a table."""
    lines = [
        f"| frames to {', '.join(LISTENERS)} by | p50 (ms) | p99 (ms) | camera (cores) | one listener | router | all five | lost |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {'shared memory' if w.shared else 'plain TCP'} | {w.p50_ms:.2f} | {w.p99_ms:.2f} | {w.camera_cores:.3f} | {w.listener_cores:.3f} | {w.router_cores:.3f} "
        f"| {w.cores:.2f} | {w.lost} |"
        for w in ways
    ]
    return "\n".join(lines)
