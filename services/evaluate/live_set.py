"""Services as processes of their own, fed with raw frames and watched: what the live benchmarks run.

The benchmark's process is the sensor: it holds the images in memory, as a camera would deliver them, and hands them to
the camera service at the rate asked for, stamped when it does. Frames are dropped where a service is still busy.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.camera import RgbdFrame
from schemas.topics import PREVIEW_IMAGE, SIM_RGBD
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, code_version
from services.evaluate.passages import Passages
from services.evaluate.processes import Processes
from services.evaluate.usage import Meter, Usage

if TYPE_CHECKING:
    from services.common.bus import Bus

SCENE = "multi-04"
FRAMES, QUICK_FRAMES = 330, 90
READY_WITHIN_S = 240.0
"""Kernels that are not in the cache yet take minutes."""
SENSOR, STAND_IN = "sensor and observer", "simulated autopilot"
_RECORDED_HZ = 15.0
_SETTLE_S = 2.0
_DRAIN_S = 2.0
_CHECK_EVERY = 15


def live_config(folder: Path) -> TreedockConfig:
    """Return the defaults with a free router port, the simulated sensor as source, and all state in ``folder``."""
    from services.cli.run_plan import with_port, with_recorder, with_state
    from services.common.session import free_port

    base = TreedockConfig()
    tree = with_port(base.model_copy(update={
        "background_gives_way": True,
        "camera": base.camera.model_copy(update={"source": "sim"}),
        "autopilot": base.autopilot.model_copy(update={"connection": f"udpin:127.0.0.1:{free_port()}"}),
    }), fixed=False)  # fmt: skip
    return with_recorder(with_state(tree, folder / "state"), folder / "recordings", None)


def frames_for(options: BenchOptions) -> tuple[str, list[RgbdFrame]]:
    """Return the recording that was asked for by name, and its raw frames: one of ours, or ``--scenes tum:DIR``."""
    name = options.scenes[0] if options.scenes else SCENE
    if options.seed is not None and not options.scenes:
        name = f"random-multi-{options.seed}"
    wanted = QUICK_FRAMES if options.quick else FRAMES
    return name, read_frames(_recording(name, wanted, options), wanted)


def told(name: str, frames: Sequence[RgbdFrame]) -> str:
    """Return the line on a recording for a benchmark's conditions."""
    size = frames[0].intrinsics
    return f"{name}, {len(frames)} raw frames of {size.width}x{size.height} from memory"


def _recording(name: str, frames: int, options: BenchOptions) -> Path:
    """Return the folder of a recording; a rendered one is kept for the next call."""
    if name.startswith("tum:"):
        return Path(name.removeprefix("tum:"))
    from services.simulator.catalogue import scene_by_name
    from services.simulator.write import write_sequence

    store = options.out / "sequences"
    kept = store / f"latency-{name}-{frames}-{code_version(('services.simulator',))}"
    if not kept.is_dir():
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"latency-{name}-", dir=store) as folder:
            options.tell(f"rendering {frames} frames of {name}")
            sequence = Path(folder) / name
            write_sequence(scene_by_name(name), sequence, rate_hz=_RECORDED_HZ, frames=frames)
            sequence.rename(kept)
    return kept


def read_frames(recording: Path, count: int) -> list[RgbdFrame]:
    """Return the first good frames of a recording.

    Raises:
        InputError: there are none, or the recording cannot be used.
    """
    from services.camera.sources import open_recording

    source = open_recording(recording, TreedockConfig().camera)
    frames = list(itertools.islice((item for item in source if isinstance(item, RgbdFrame)), count))
    if not frames:
        raise InputError(f"{recording}: no usable frame")
    return frames


def send(bus: Bus, frames: Sequence[RgbdFrame], rate_hz: float, running: Processes) -> None:
    """Hand out the frames, each at its time."""
    begin_s = time.monotonic()
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, begin_s + k / rate_hz - time.monotonic()))
        bus.publish(SIM_RGBD, replace(frame, stamp_ns=time.time_ns(), seq=k))
        if k % _CHECK_EVERY == 0:
            running.check()


@dataclass(frozen=True)
class Flight:
    """What a run of the whole set gave."""

    seen: Passages
    used: Mapping[str, Usage]
    """By service; beside them ``SENSOR`` and ``STAND_IN``, which no aircraft has."""
    ready_s: float
    """From the first service's start until all were ready; the router ran already."""

    @property
    def aboard(self) -> Mapping[str, Usage]:
        """What the services used."""
        return {name: usage for name, usage in self.used.items() if name not in {SENSOR, STAND_IN}}

    @property
    def dropped(self) -> int:
        """Frames handed to the camera that no target answered."""
        return self.seen.sent - sum(p.target_ns > 0 for p in self.seen.by_stamp.values())


def fly(frames: Sequence[RgbdFrame], rate_hz: float, services: Sequence[str], *, autopilot: bool = False) -> Flight:
    """Run services over raw frames at a rate, and watch them.

    Args:
        frames: of a recording.
        rate_hz: at which they are handed out.
        services: beside the router.
        autopilot: whether the simulated one stands in for PX4, in a process of its own.

    Raises:
        InputError: a service ended, or was not ready in time.
    """
    with tempfile.TemporaryDirectory(prefix="treedock-live-") as folder:
        config = live_config(Path(folder))
        with (
            Processes(config, Path(folder)) as running,
            observed(running, config.router.endpoint, config.uav) as (bus, seen),
        ):
            begin_s = time.monotonic()
            for name in services:
                running.start(name)
            running.wait(lambda: all(bus.alive(name) for name in services), READY_WITHIN_S, "services to be ready")
            ready_s = time.monotonic() - begin_s
            if autopilot:
                running.spawn(STAND_IN, "services.simulator.px4", config.autopilot.connection.rsplit(":", 1)[1])
                running.wait(lambda: seen.connected, 60.0, "the autopilot to hear its stand-in")
            time.sleep(_SETTLE_S)
            names = ("router", *services, *([STAND_IN] if autopilot else []))
            meter = Meter({SENSOR: os.getpid(), **{name: running.pid(name) for name in names}})
            send(bus, frames, rate_hz, running)
            meter.stop()
            time.sleep(_DRAIN_S)
            used = meter.read()
            seen.sent = len(frames)
    return Flight(seen, used, ready_s)


@contextmanager
def observed(running: Processes, endpoint: str, uav: str) -> Iterator[tuple[Bus, Passages]]:
    """Start the router, and open the session of the sensor, which also observes and looks at the preview."""
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_client

    running.start("router")
    with opened_client(endpoint, lambda: False, wait_s=60.0) as session:
        bus, seen = Bus(session, uav, HealthBook()), Passages()
        seen.observe(bus)
        bus.subscribe_keys(PREVIEW_IMAGE, lambda _key, _picture: None, at_once=True)
        bus.alive("router")
        yield bus, seen
