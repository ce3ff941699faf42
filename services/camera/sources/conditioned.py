"""A source with its frames watched and conditioned: what every reader of a recording or sensor gets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from schemas.camera import RgbdFrame
from services.camera.codecs import FrameError, decode_depth_raw
from services.camera.conditioning import Conditioner
from services.camera.config import CameraConfig
from services.camera.plausible import DepthScaleWatch
from services.camera.sources.base import BadFrame, Source
from services.camera.sources.strays import without_strays
from services.camera.watch import StreamWatch, fingerprint


class ConditionedSource:
    """Passes a source's frames through the watch and the depth pipeline."""

    def __init__(self, source: Source, config: CameraConfig) -> None:
        self._source = source
        self._conditioner = Conditioner(config)
        self._scale = DepthScaleWatch(config.min_range_m, config.max_range_m)
        self.watch = StreamWatch(stall_s=config.stall_s)
        self.stage_ms: dict[str, list[float]] = defaultdict(list)
        """Durations of each stage, one for each frame; who reads them may empty them."""
        self.name = source.name
        self.expected = source.expected
        self.paced = source.paced
        self.remark = source.remark

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield the source's frames, conditioned."""
        for item in without_strays(self._source):
            yield self._conditioned(item) if isinstance(item, RgbdFrame) else item

    def note(self) -> str:
        """Return what is wrong with the stream at present, in one line; empty when all is well."""
        return "; ".join(part for part in (self.watch.note(), self._scale.note()) if part)

    def total(self) -> str:
        """Return what was wrong over the whole stream, in one line; empty for nothing."""
        return "; ".join(part for part in (self.watch.total(), self._scale.total(), self._source.remark) if part)

    def _conditioned(self, frame: RgbdFrame) -> RgbdFrame | BadFrame:
        self.watch.see(frame.stamp_ns, fingerprint(frame))
        try:
            self._scale.see(decode_depth_raw(frame), frame.intrinsics.depth_scale)
            out = self._conditioner.apply(frame)
        except FrameError as error:
            return BadFrame(frame.stamp_ns, f"{self.name}: {error}")
        for stage, ms in self._conditioner.stage_ms.items():
            self.stage_ms[stage].append(ms)
        return out
