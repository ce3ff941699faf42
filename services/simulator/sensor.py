"""What the sensor makes of perfect images: an active stereo camera's depth, a noisy colour, an accelerometer.

Depth follows the disparity ``d = f B / z`` (B 70 mm, f 565 px at 640: the R200). Matching noise of s px in d gives
``sigma_z = z^2 s / (f B)``; part of it is a fixed pattern of the image, so averaging does not remove it; neighbours
share it, as they share the matching window. At a depth edge the window holds both sides: 5 mixed pixels. What the
second infrared camera cannot see is a hole beside the nearer object. Other cameras and a time-of-flight one: models.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.simulator.config import SensorConfig
from services.simulator.models import CAMERA_MODELS, blind_pixels, settings_of
from services.simulator.render import DEFAULT_INTRINSICS, Rendering
from services.simulator.scene import Floats
from services.simulator.time_of_flight import WINDOW_PX, dropout_quantile, measure
from services.simulator.world import Floats32

GRAVITY_M_S2 = 9.80665

_WINDOW_PX = 5
_EDGE_DISPARITY_PX = 0.7
_BANK = 12
_MARGIN_PX = 64
_GRAIN_PX = 1.6
"""Standard deviation of the blur that makes neighbouring pixels share their noise (full-size pixels)."""


@dataclass(frozen=True, slots=True)
class SensorImages:
    """What the camera puts out, always at full size."""

    colour: NDArray[np.uint8]
    """(H, W, 3) BGR."""
    depth: NDArray[np.uint16]
    """(H, W) millimetres, zero where there is no data."""


class RgbdSensor:
    """Turns renderings of one size into the camera's images; frame ``seq`` gets the same noise in every run."""

    def __init__(
        self, config: SensorConfig, shape: tuple[int, int], render_scale: float = 1.0, seed: int = 0,
        intrinsics: Intrinsics = DEFAULT_INTRINSICS,
    ) -> None:  # fmt: skip
        """Prepare the noise for renderings of ``shape`` (H, W), which are scaled up by ``1 / render_scale``.

        ``intrinsics`` are the renderings'; the simulator's own camera does not ask for them.
        """
        self._config = config = settings_of(config)
        self._intrinsics = intrinsics
        self._blind = blind_pixels(CAMERA_MODELS[config.model], intrinsics)
        self._scale = render_scale
        own = config.model == "own"
        self._shift_share = render_scale if own else intrinsics.fx / config.focal_px
        """Image pixels by which a disparity of one pixel shifts the second camera's view."""
        self._seed = seed
        rng = np.random.default_rng([seed, 301])
        grain = _GRAIN_PX * render_scale
        padded = (shape[0] + _MARGIN_PX, shape[1] + _MARGIN_PX)
        self._fixed = _grainy(rng, shape, grain)
        self._bank = np.stack([_grainy(rng, padded, grain) for _ in range(_BANK)])
        self._colour_noise = rng.normal(0.0, config.colour_sigma, (*padded, 3)).astype(np.float32)

    def expose(self, rendering: Rendering, seq: int) -> SensorImages:
        """Return the camera's images of a rendering."""
        rng = np.random.default_rng([self._seed, 302, seq])
        depth = self._measure(rendering.depth_m, rng)
        colour = self._expose_colour(rendering.colour, rng, seq)
        if self._scale == 1.0:
            return SensorImages(colour, depth)
        import cv2

        times = round(1.0 / self._scale)
        size = (colour.shape[1] * times, colour.shape[0] * times)
        larger = np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        return SensorImages(larger, np.repeat(np.repeat(depth, times, axis=0), times, axis=1))

    def _measure(self, depth_m: Floats32, rng: np.random.Generator) -> NDArray[np.uint16]:
        config = self._config
        if config.sunlight and config.model == "kinect1":
            return np.zeros(depth_m.shape, dtype=np.uint16)
        timed = config.law == "time_of_flight"
        out = self._timed(depth_m, rng) if timed else self._triangulated(depth_m, rng)
        if self._blind is not None:
            out[self._blind] = 0
        return out

    def _timed(self, depth_m: Floats32, rng: np.random.Generator) -> NDArray[np.uint16]:
        import cv2

        c, i = self._config, self._intrinsics
        window = np.ones((WINDOW_PX, WINDOW_PX), dtype=np.uint8)
        solid = np.minimum(depth_m, np.float32(100.0))
        spread = np.asarray(cv2.dilate(solid, window) - cv2.erode(solid, window), dtype=np.float32)
        mixed = np.asarray(cv2.blur(solid, (WINDOW_PX, WINDOW_PX)), dtype=np.float32)
        limits = (c.min_range_m, c.fade_range_m, c.max_range_m, c.dropout)
        out = np.zeros(depth_m.shape, dtype=np.uint16)
        measure(solid, spread, mixed, self._noise(rng), self._draw(rng), (i.fx, i.fy), limits, out)
        return out

    def _noise(self, rng: np.random.Generator) -> Floats32:
        """Return a field of unit variance, part of it the same in every frame."""
        noise = 0.8 * self._draw(rng) + 0.6 * self._draw(rng)
        fixed = np.float32(np.sqrt(self._config.fixed_share))
        noise = fixed * self._fixed + np.float32(np.sqrt(1.0 - self._config.fixed_share)) * noise
        return np.asarray(noise.astype(np.float32))

    def _triangulated(self, depth_m: Floats32, rng: np.random.Generator) -> NDArray[np.uint16]:
        import cv2

        config = self._config
        disparity = (np.float32(config.focal_px * config.baseline_m) / depth_m).astype(np.float32)
        if config.disparity_sigma_px == 0.0:
            return _quantised(depth_m, config.min_range_m, config.max_range_m)
        window = np.ones((_WINDOW_PX, _WINDOW_PX), dtype=np.uint8)
        spread = np.asarray(cv2.dilate(disparity, window) - cv2.erode(disparity, window), dtype=np.float32)
        mixed = np.asarray(cv2.blur(disparity, (_WINDOW_PX, _WINDOW_PX)), dtype=np.float32)
        noise = self._noise(rng)
        out = np.zeros(depth_m.shape, dtype=np.uint16)
        _stereo(
            disparity, spread, mixed, noise, self._draw(rng), self._shift_share, config.disparity_sigma_px,
            config.disparity_step_px, config.focal_px * config.baseline_m, config.min_range_m, config.fade_range_m,
            config.max_range_m, config.dropout, out,
        )  # fmt: skip
        return out

    def _draw(self, rng: np.random.Generator) -> Floats32:
        """Return a window of a random noise field of the bank."""
        index, v, u = rng.integers(0, (_BANK, _MARGIN_PX, _MARGIN_PX))
        height, width = self._fixed.shape
        return np.asarray(self._bank[index, v : v + height, u : u + width])

    def _expose_colour(self, colour: NDArray[np.uint8], rng: np.random.Generator, seq: int) -> NDArray[np.uint8]:
        v, u = rng.integers(0, _MARGIN_PX, 2)
        gain = 1.0 + self._config.exposure_swing * np.sin(0.05 * seq)
        out = np.empty_like(colour)
        _grain(colour, self._colour_noise[v : v + colour.shape[0], u : u + colour.shape[1]], gain, out)
        return out


def _grainy(rng: np.random.Generator, shape: tuple[int, int], grain_px: float) -> Floats32:
    """Return normal noise with unit variance whose grains are a few pixels wide."""
    import cv2

    field = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), grain_px)
    field -= field.mean()
    return np.asarray(field / field.std(), dtype=np.float32)


def _quantised(depth_m: Floats32, near_m: float, far_m: float) -> NDArray[np.uint16]:
    good = (depth_m >= near_m) & (depth_m <= far_m)
    return np.where(good, np.round(np.where(good, depth_m, 0.0) * 1000.0), 0.0).astype(np.uint16)


@njit(cache=True, nogil=True, error_model="numpy")
def _stereo(
    disparity: Floats32, spread: Floats32, mixed: Floats32, noise: Floats32, holes: Floats32, scale: float,
    sigma_px: float, step_px: float, focal_baseline: float, near_m: float, fade_m: float, far_m: float, dropout: float,
    out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Fill ``out`` with millimetres. ``holes`` is a unit normal field that says where matching fails first."""
    height, width = disparity.shape
    tail = dropout_quantile(dropout)
    for v in range(height):
        seen = 1e9
        for u in range(width - 1, -1, -1):
            d = disparity[v, u]
            in_right = u - scale * d
            shadowed = in_right > seen + 1.0
            seen = min(seen, in_right)
            # a steep plane has a wide spread too, but its window's mean is its own value
            edge = spread[v, u] > _EDGE_DISPARITY_PX and abs(mixed[v, u] - d) > 0.1 * spread[v, u]
            if shadowed:
                continue
            if edge:
                d = mixed[v, u]
            limit = tail
            if edge:
                limit = -0.4
            d += sigma_px * noise[v, u]
            if step_px > 0.0:
                d = step_px * np.round(d / step_px)
            if d <= 0.0:
                continue
            z = focal_baseline / d
            if z < near_m or z > far_m:
                continue
            if z > fade_m:
                limit = max(limit, -2.0 + 4.0 * (z - fade_m) / (far_m - fade_m))
            if holes[v, u] < limit:
                continue
            out[v, u] = np.uint16(z * 1000.0 + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _grain(colour: NDArray[np.uint8], noise: Floats32, gain: float, out: NDArray[np.uint8]) -> None:
    for v in range(colour.shape[0]):
        for u in range(colour.shape[1]):
            for c in range(3):
                value = gain * colour[v, u, c] + noise[v, u, c] + 0.5
                out[v, u, c] = np.uint8(min(255.0, max(0.0, value)))


class Accelerometer:
    """Specific force in the camera frame, with white noise and a constant bias. At rest it points up."""

    def __init__(self, config: SensorConfig, seed: int = 0) -> None:
        self._sigma = config.accel_sigma_m_s2
        self._rng = np.random.default_rng([seed, 303])
        self._bias = self._rng.normal(0.0, config.accel_bias_m_s2, 3)

    def measure(self, R_world_camera: Floats, acceleration_world_m_s2: Floats) -> tuple[float, float, float]:
        """Return one reading; readings differ by noise from call to call."""
        force = R_world_camera.T @ (acceleration_world_m_s2 + np.array([0.0, 0.0, GRAVITY_M_S2]))
        x, y, z = (float(value) for value in force + self._bias + self._rng.normal(0.0, self._sigma, 3))
        return x, y, z
