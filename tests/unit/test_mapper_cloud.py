from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from services.mapper.cloud import KeyframeCloud, keyframe_cloud, pixel_rays
from services.mapper.config import MapperConfig

K = Intrinsics(width=160, height=120, fx=125.0, fy=125.0, cx=79.5, cy=59.5)
RAYS = pixel_rays(K)


def _cloud(depth: np.ndarray, config: MapperConfig | None = None) -> KeyframeCloud:
    return keyframe_cloud(depth.astype(np.float32), None, RAYS, config or MapperConfig())


def test_plane_comes_back_in_camera_axes() -> None:
    cloud = _cloud(np.full((120, 160), 2.0))
    assert cloud.points_m[:, 2] == pytest.approx(2.0)
    assert cloud.points_m[:, 0].min() == pytest.approx(-79.5 / 125 * 2, abs=0.02)
    assert cloud.points_m[:, 1].max() == pytest.approx(59.5 / 125 * 2, abs=0.02)
    assert len(cloud.points_m) == pytest.approx(160 * 120, rel=0.02)


def test_pass_through_and_empty() -> None:
    assert len(_cloud(np.zeros((120, 160))).points_m) == 0
    assert len(_cloud(np.full((120, 160), 0.4)).points_m) == 0
    assert len(_cloud(np.full((120, 160), 6.1)).points_m) == 0


def test_voxel_grid_takes_centroids() -> None:
    depth = np.full((120, 160), 0.6)  # pixels 4.8 mm apart: about four to a voxel
    cloud = _cloud(depth)
    assert len(cloud.points_m) < 0.35 * depth.size
    cells = np.floor(cloud.points_m / 0.01)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_mixed_pixels_at_an_edge_go_and_both_surfaces_stay() -> None:
    depth = np.full((120, 160), 5.0)
    depth[:, 60:100] = 2.0
    depth[:, 57:60] = [4.2, 3.5, 2.7]  # what a matching window makes of the edge
    depth[:, 100:103] = [2.7, 3.5, 4.2]
    z = _cloud(depth).points_m[:, 2]
    assert np.count_nonzero((z > 2.3) & (z < 4.7)) == 0
    assert np.count_nonzero(z < 2.3) > 0.9 * 40 * 120
    assert np.count_nonzero(z > 4.7) > 0.9 * 114 * 120


def test_lonely_points_go() -> None:
    depth = np.zeros((120, 160))
    depth[40:80, 40:120] = 3.0
    depth[10, 10] = depth[100, 130] = 2.0
    z = _cloud(depth).points_m[:, 2]
    assert z == pytest.approx(3.0)


def test_slanted_ground_stays() -> None:
    v = np.arange(120)[:, None]
    depth = np.where(v > 75, 1.5 * 125.0 / np.maximum(v - 59.5, 1.0), 0.0) * np.ones((1, 160))
    inside = (depth >= 0.5) & (depth <= 6.0)
    config = MapperConfig(voxel_m=0.001)
    assert len(_cloud(depth, config).points_m) > 0.93 * np.count_nonzero(inside)


def test_distortion_is_removed() -> None:
    import cv2

    bent = Intrinsics(
        width=160, height=120, fx=125.0, fy=125.0, cx=79.5, cy=59.5, k1=0.26, k2=-0.95, p1=-0.005, p2=0.0026, k3=1.16
    )
    rays = pixel_rays(bent)
    K3 = np.array([[125.0, 0, 79.5], [0, 125.0, 59.5], [0, 0, 1]])
    points = np.dstack([rays, np.ones(rays.shape[:2])]).reshape(-1, 3).astype(np.float64)
    back, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K3, np.array([0.26, -0.95, -0.005, 0.0026, 1.16]))
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    good = np.isfinite(rays[..., 0].ravel())
    assert good.mean() > 0.9
    assert back.reshape(-1, 2)[good] == pytest.approx(np.stack([u.ravel(), v.ravel()], axis=1)[good], abs=0.25)


def test_colour_is_the_mean_of_the_voxel() -> None:
    rgb = np.zeros((120, 160, 3), dtype=np.uint8)
    rgb[:, :, 0], rgb[:, :, 2] = 200, 30
    cloud = keyframe_cloud(np.full((120, 160), 1.0, dtype=np.float32), rgb, RAYS, MapperConfig())
    assert (cloud.rgb == [200, 0, 30]).all()
    assert cloud.rgb.shape == cloud.points_m.shape
