"""A frame's way from the camera to slam, refiner and preview: by shared memory, and by plain TCP beside it."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
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
    """Frames that a listener did not get, of all three."""

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
                for role in ("camera", *LISTENERS):
                    running.stop(role)
        ages = [json.loads(_out(folder, role).read_text(encoding="utf-8")) for role in LISTENERS]
    return _way(ages, {role: usage.cpu_cores for role, usage in used.items()}, shared=shared)


def _out(folder: Path, role: str) -> Path:
    return folder / f"{role}.ages.json"


def _way(ages_ms: Sequence[Sequence[float]], cores: dict[str, float], *, shared: bool) -> Way:
    counts = [len(ages) for ages in ages_ms]
    if not all(counts):
        raise InputError(f"frames came to {sum(n > 0 for n in counts)} of {len(counts)} listeners only")
    together = np.concatenate([np.array(ages) for ages in ages_ms])
    p50, p99 = np.quantile(together, [0.5, 0.99])
    return Way(
        shared, round(float(p50), 2), round(float(p99), 2), round(cores["camera"], 3),
        round(float(np.mean([cores[role] for role in LISTENERS])), 3), round(cores["router"], 3),
        sum(max(counts) - n for n in counts),
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
