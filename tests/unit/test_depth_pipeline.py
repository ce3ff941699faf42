from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from services.camera.depth import kernels
from services.camera.depth.config import DepthConfig
from services.camera.depth.geometry import register, undistort_depth
from services.camera.depth.kernels import Image
from services.camera.depth.pipeline import DepthPipeline

SHAPE = (48, 64)
OFF = DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False)
FULL = DepthConfig(drop_mixed=True, bilateral=True, fill_holes=True)
SMALL = Intrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)


def _step(near_m: float = 1.5, far_m: float = 3.0) -> Image:
    """A near object on the left half, a far one on the right."""
    depth = np.full(SHAPE, far_m, np.float32)
    depth[:, :32] = near_m
    return depth


def _run(depth: Image, config: DepthConfig, grey: np.ndarray | None = None) -> Image:
    return DepthPipeline(config, depth.shape).process(depth, grey).depth_m


def test_range_and_nonsense_become_no_data() -> None:
    depth = np.array([[0.2, 0.5, 3.0, 6.0, 6.5, np.nan, np.inf, -1.0, 0.0]], np.float32)
    assert np.allclose(_run(depth, OFF), [[0, 0.5, 3.0, 6.0, 0, 0, 0, 0, 0]], atol=1e-5)


def test_every_stage_can_be_switched_and_is_timed() -> None:
    pipeline = DepthPipeline(FULL.model_copy(update={"temporal": True}), SHAPE)
    assert set(pipeline.process(_step()).stage_ms) == {"range", "mixed", "bilateral", "fill", "temporal"}
    assert set(DepthPipeline(OFF, SHAPE).process(_step()).stage_ms) == {"range"}


def test_input_is_left_alone_and_wrong_size_is_refused() -> None:
    depth = _step()
    before = depth.copy()
    _run(depth, FULL)
    assert np.array_equal(depth, before)
    with pytest.raises(ValueError, match="expected"):
        DepthPipeline(FULL, (10, 10)).process(depth)


def test_bilateral_denoises_and_keeps_the_edge() -> None:
    rng = np.random.default_rng(1)
    true = _step()
    noisy = (true + 0.002 * true**2 * rng.normal(size=SHAPE)).astype(np.float32)
    out = _run(noisy, OFF.model_copy(update={"bilateral": True}))
    assert np.std((out - true)[:, 3:28]) < 0.5 * np.std((noisy - true)[:, 3:28])
    assert np.max(np.abs(out - true)[:, 28:36]) < 0.06


def test_bilateral_does_not_pull_towards_holes() -> None:
    depth = _step()
    depth[::3, ::3] = 0.0
    out = _run(depth, OFF.model_copy(update={"bilateral": True}))
    assert np.all(out[depth == 0] == 0)
    assert np.allclose(out[depth > 0], depth[depth > 0], atol=1e-3)


@pytest.mark.parametrize("guided", [True, False])
def test_holes_are_filled_on_one_surface_but_never_across_objects(guided: bool) -> None:
    depth = _step()
    depth[10:12, 10:12] = 0.0
    depth[:, 31:34] = 0.0
    grey = np.where(np.arange(64) < 32, 60, 180).astype(np.uint8) * np.ones(SHAPE, np.uint8)
    out = _run(depth, OFF.model_copy(update={"fill_holes": True}), grey if guided else None)
    assert np.allclose(out[10:12, 10:12], 1.5, atol=1e-3)
    near, far = np.abs(out - 1.5) < 0.01, np.abs(out - 3.0) < 0.01
    assert np.all((out == 0) | near | far), "a value between two objects is neither"
    assert np.all(out[:, 31:34] == 0)


def test_large_holes_stay() -> None:
    depth = _step()
    depth[:, 5:25] = 0.0
    out = _run(depth, OFF.model_copy(update={"fill_holes": True}))
    assert np.all(out[:, 10:20] == 0)


def test_a_hole_whose_grey_is_foreign_stays() -> None:
    depth = np.full(SHAPE, 2.0, np.float32)
    depth[20:22, 20:22] = 0.0
    grey = np.full(SHAPE, 100, np.uint8)
    grey[20:22, 20:22] = 200
    out = _run(depth, OFF.model_copy(update={"fill_holes": True}), grey)
    assert np.all(out[20:22, 20:22] == 0)


def test_mixed_pixels_are_dropped_and_slopes_kept() -> None:
    depth = _step()
    depth[:, 32] = 2.1
    out = _run(depth, OFF.model_copy(update={"drop_mixed": True}))
    assert np.all(out[:, 32] == 0)
    assert np.all(out[:, :29] == depth[:, :29])
    slope = np.tile(np.linspace(1.5, 2.1, 64, dtype=np.float32), (48, 1))
    assert np.all(_run(slope, OFF.model_copy(update={"drop_mixed": True})) > 0)


def test_temporal_averages_noise_and_forgets_at_once_on_change() -> None:
    rng = np.random.default_rng(2)
    pipeline = DepthPipeline(OFF.model_copy(update={"temporal": True}), SHAPE)
    for _ in range(12):
        out = pipeline.process((2.0 + 0.004 * rng.normal(size=SHAPE)).astype(np.float32)).depth_m
    assert np.std(out) < 0.75 * 0.004
    out = pipeline.process(np.full(SHAPE, 2.5, np.float32)).depth_m
    assert np.allclose(out, 2.5, atol=1e-5)


def test_registration_of_a_plane_and_an_object() -> None:
    depth = np.full(SHAPE, 3.0, np.float32)
    depth[:, 28:36] = 1.5
    T = np.eye(4)
    T[0, 3] = -0.06
    out = register(depth, SMALL, SMALL, T)
    # the object moves by f t / z = 2 px, the wall by 1 px: the object covers the wall, and uncovers a hole
    assert np.all(out[:, 26:34] == pytest.approx(1.5))
    assert np.all(out[:, :25] == pytest.approx(3.0))
    assert np.count_nonzero(out[20]) >= 60


def test_registration_to_a_finer_camera_leaves_no_gaps() -> None:
    fine = Intrinsics(width=128, height=96, fx=100.0, fy=100.0, cx=63.5, cy=47.5)
    out = register(np.full(SHAPE, 2.0, np.float32), SMALL, fine, np.eye(4))
    assert np.all(out[2:-2, 2:-2] == pytest.approx(2.0))


def test_undistorted_depth_mixes_no_depths() -> None:
    camera = SMALL.model_copy(update={"k1": 0.2, "k2": -0.1})
    out = undistort_depth(_step(), camera)
    assert set(np.unique(np.round(out, 4))) <= {0.0, 1.5, 3.0}
    # the centre stays, points outside move outwards in the distorted image (k1 > 0): there we look further out
    assert out[23, 20] == pytest.approx(1.5)


def test_same_input_same_bytes() -> None:
    rng = np.random.default_rng(3)
    depth = (2.0 + 0.01 * rng.normal(size=SHAPE)).astype(np.float32)
    assert _run(depth, FULL).tobytes() == _run(depth, FULL).tobytes()


def test_inverse_and_back() -> None:
    depth = _step()
    inverse, back = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32)
    kernels.to_inverse(depth, 0.5, 6.0, inverse)
    kernels.to_depth(inverse, back)
    assert np.allclose(back, depth, rtol=1e-6)
