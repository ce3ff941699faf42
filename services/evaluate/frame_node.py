"""One end of a frame's way as a service of its own: it sends frames, or takes them; what it saw goes to a file at the end.

``python -m services.evaluate.frame_node ROLE CONFIG OUT WIDTH HEIGHT RATE_HZ``: ROLE ``camera`` sends, every other listens.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from schemas.camera import Intrinsics, RgbdFrame
from schemas.topics import CAMERA_RGBD
from services.common.config import load_config
from services.common.context import Context
from services.common.process import die_with_parent, prepare_process
from services.common.runtime import run_service


class Sender:
    """Sends one and the same picture at a rate, stamped as it goes."""

    def __init__(self, context: Context, out: Path, width: int, height: int, rate_hz: float) -> None:
        self._context, self._out = context, out
        self._camera = Intrinsics(
            width=width, height=height, fx=float(width), fy=float(width), cx=width / 2.0, cy=height / 2.0
        )
        self._colour, self._depth = bytes(3 * width * height), bytes(2 * width * height)
        self._seq = 0
        context.every(1.0 / rate_hz, self.tick)
        context.on_stop(self.write)

    def tick(self) -> None:
        """Send one."""
        stamp_ns = time.time_ns()
        self._context.publish(CAMERA_RGBD, RgbdFrame(
            stamp_ns=stamp_ns, seq=self._seq, intrinsics=self._camera, colour=self._colour, depth=self._depth
        ))  # fmt: skip
        self._seq += 1

    def write(self) -> None:
        """Keep how many were sent."""
        self._out.write_text(json.dumps(self._seq), encoding="utf-8")


class Listener:
    """Notes how old each frame is when it comes to its handler, by its number."""

    def __init__(self, context: Context, out: Path) -> None:
        self._ages_ms: dict[int, float] = {}
        self._out = out
        context.on(CAMERA_RGBD, self.on_frame)
        context.on_stop(self.write)

    def on_frame(self, frame: RgbdFrame) -> None:
        """Note one."""
        self._ages_ms[frame.seq] = (time.time_ns() - frame.stamp_ns) * 1e-6

    def write(self) -> None:
        """Keep what was seen."""
        self._out.write_text(json.dumps(self._ages_ms), encoding="utf-8")


def main() -> int:
    """Run until stopped, or until the benchmark that started this ends."""
    die_with_parent()
    role, config, out, width, height, rate_hz = sys.argv[1:7]

    def build(context: Context) -> object:
        if role == "camera":
            return Sender(context, Path(out), int(width), int(height), float(rate_hz))
        return Listener(context, Path(out))

    return run_service(role, build, load_config(Path(config)))


if __name__ == "__main__":
    prepare_process()
    sys.exit(main())
