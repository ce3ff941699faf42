"""The depth pipeline: range, mixed pixels, bilateral denoising, hole filling, temporal filter, each timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.camera.depth import kernels
from services.camera.depth.config import DepthConfig
from services.camera.depth.kernels import Grey, Image

_MIXED_SIGMAS = 8.0
_MIXED_GAP_M = 0.05
"""Mixed pixels matter where they hang further than this from either surface."""
_MIXED_REACH_PX = 4
_SAME_SURFACE_SIGMAS = 8.0
_TEMPORAL_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Processed:
    """A processed depth image and what each stage took."""

    depth_m: Image
    stage_ms: dict[str, float]


class DepthPipeline:
    """Keeps its buffers and the temporal filter's past; one per camera."""

    def __init__(
        self, config: DepthConfig, shape: tuple[int, int], min_range_m: float = 0.5, max_range_m: float = 6.0
    ) -> None:
        self._config = config
        self._range_m = (min_range_m, max_range_m)
        self._shape = shape
        self._a, self._b = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._past = np.zeros(shape, np.float32)
        self._extremes = [np.zeros(shape, np.float32) for _ in range(4)]
        self._no_grey: Grey = np.zeros((1, 1), np.uint8)

    def process(self, depth_m: Image, grey: Grey | None = None) -> Processed:
        """Return the processed image (H, W) float32 metres, zero where there is no data.

        Args:
            depth_m: (H, W) float32 metres; zero, NaN and anything out of range is no data.
            grey: (H, W) uint8, registered to the depth; it guides the hole filling.

        Raises:
            ValueError: an image of another shape than the pipeline was made for.
        """
        if depth_m.shape != self._shape or (grey is not None and grey.shape != self._shape):
            raise ValueError(f"depth image of shape {depth_m.shape}, expected {self._shape}, grey image the same")
        stage_ms: dict[str, float] = {}
        begin = time.perf_counter()
        kernels.to_inverse(depth_m, self._range_m[0], self._range_m[1], self._a)
        begin = _lap(stage_ms, "range", begin)
        for name, stage in self._stages(grey):
            stage(self._a, self._b)
            self._a, self._b = self._b, self._a
            begin = _lap(stage_ms, name, begin)
        out = np.empty(self._shape, np.float32)
        kernels.to_depth(self._a, out)
        _lap(stage_ms, "range", begin)
        return Processed(out, stage_ms)

    def _stages(self, grey: Grey | None) -> list[tuple[str, Callable[[Image, Image], None]]]:
        config = self._config
        stages: list[tuple[str, Callable[[Image, Image], None]]] = []
        if config.drop_mixed:
            stages.append(("mixed", self._drop_mixed))
        if config.bilateral:
            stages.append(("bilateral", self._bilateral))
        if config.fill_holes:
            stages.append(("fill", lambda image, out: self._fill(image, grey, out)))
        if config.temporal:
            stages.append(("temporal", self._temporal))
        return stages

    def _drop_mixed(self, image: Image, out: Image) -> None:
        """Compare with the extremes along row and column first: nine pixels of ten need no closer look."""
        import cv2

        side = 2 * _MIXED_REACH_PX + 1
        extremes = self._extremes
        for k, shape in enumerate(((1, side), (side, 1))):
            window = np.ones(shape, np.uint8)
            cv2.dilate(image, window, dst=extremes[2 * k])
            cv2.erode(image, window, dst=extremes[2 * k + 1])
        noise = _MIXED_SIGMAS * self._config.sigma_inverse
        kernels.drop_mixed(
            image, extremes[0], extremes[1], extremes[2], extremes[3], noise, _MIXED_GAP_M, _MIXED_REACH_PX, out
        )

    def _bilateral(self, image: Image, out: Image) -> None:
        """Bilateral filter (Tomasi and Manduchi 1998). A hole is so far from any data that neither sees the other."""
        import cv2

        config = self._config
        sigma = config.bilateral_sigmas * config.sigma_inverse
        cv2.bilateralFilter(image, config.bilateral_diameter_px, sigma, config.bilateral_sigma_px, dst=out)

    def _fill(self, image: Image, grey: Grey | None, out: Image) -> None:
        config = self._config
        same = _SAME_SURFACE_SIGMAS * config.sigma_inverse
        guide = self._no_grey if grey is None else grey
        kernels.fill_holes(image, guide, grey is not None, config.fill_reach_px, config.fill_grey_sigma, same, out)

    def _temporal(self, image: Image, out: Image) -> None:
        config = self._config
        kernels.blend(image, self._past, config.temporal_share, _TEMPORAL_SIGMAS * config.sigma_inverse, out)
        self._past[:] = out


def _lap(stage_ms: dict[str, float], name: str, begin: float) -> float:
    now = time.perf_counter()
    stage_ms[name] = stage_ms.get(name, 0.0) + (now - begin) * 1e3
    return now


def warm() -> None:
    """Compile or load every kernel."""
    config = DepthConfig(drop_mixed=True, bilateral=True, fill_holes=True, temporal=True)
    DepthPipeline(config, (16, 16)).process(np.ones((16, 16), np.float32), np.zeros((16, 16), np.uint8))
    flat = np.zeros((4, 4), np.float32)
    kernels.splat(flat, flat, flat, np.eye(4), np.ones(11), flat.copy())
