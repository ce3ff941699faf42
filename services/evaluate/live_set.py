"""Raw frames for services that run as processes of their own: what the live benchmarks feed them with.

The benchmark's process is the sensor: it holds the images in memory, as a camera would deliver them, and hands them to
the camera service at the rate asked for, stamped when it does. Frames are dropped where a service is still busy.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.camera import RgbdFrame
from schemas.topics import SIM_RGBD
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, code_version
from services.evaluate.processes import Processes

if TYPE_CHECKING:
    from services.common.bus import Bus

SCENE = "multi-04"
FRAMES, QUICK_FRAMES = 330, 90
READY_WITHIN_S = 240.0
"""Kernels that are not in the cache yet take minutes."""
_RECORDED_HZ = 15.0
_CHECK_EVERY = 15


def live_config(folder: Path) -> TreedockConfig:
    """Return the defaults with a free router port, the simulated sensor as source, and all state in ``folder``."""
    from services.cli.run_plan import with_port, with_recorder, with_state

    base = TreedockConfig()
    tree = with_port(base.model_copy(update={"camera": base.camera.model_copy(update={"source": "sim"})}), fixed=False)
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
