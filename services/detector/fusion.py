"""What the depth images say of the map's trees, fused with what the cloud says, by covariance.

Frames of one view are not independent: the sensor's fixed pattern, the bark and the pose's drift stay. So all frames
that share a keyframe make one view, whose covariance is that of its frames, however many; views are combined by their
information; and what all views have in common (``common_xy_m``, ``common_radius_m``) is added in the end.
Places are kept relative to the keyframe, so that they follow the map's corrections.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from schemas.slam import Pose
from schemas.trees import MAX_SUITABLE_RADIUS_M, MIN_SUITABLE_RADIUS_M, Target, Tree
from services.common.geometry import from_transform, inverse
from services.detector.config import FusionConfig
from services.detector.model import Floats

_KEPT_POSES = 64


@dataclass(slots=True)
class View:
    """The frames of one keyframe that measured one tree: running means, their covariance that of a single frame."""

    frames: int
    place_m: Floats
    """(3,) of the axis at the camera's height, in the keyframe's axes."""
    covariance_m2: Floats
    """(2, 2) of x and y in map."""
    radius_m: float
    radius_m2: float
    """Variance."""

    def take(self, other: View) -> None:
        """Average with a further frame's."""
        self.frames += 1
        share = 1.0 / self.frames
        self.place_m += share * (other.place_m - self.place_m)
        self.covariance_m2 += share * (other.covariance_m2 - self.covariance_m2)
        self.radius_m += share * (other.radius_m - self.radius_m)
        self.radius_m2 += share * (other.radius_m2 - self.radius_m2)


class Fusion:
    """Collects the refiner's measurements by tree and keyframe, and corrects trees with them."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._map_id = ""
        self._poses: OrderedDict[int, Pose] = OrderedDict()
        self._views: dict[int, OrderedDict[int, View]] = {}

    def clear(self, map_id: str) -> None:
        """Begin a new map."""
        self._map_id = map_id
        self._poses, self._views = OrderedDict(), {}

    def on_pose(self, pose: Pose) -> None:
        """Keep a frame's pose until its target comes."""
        self._poses[pose.stamp_ns] = pose
        while len(self._poses) > _KEPT_POSES:
            self._poses.popitem(last=False)

    def on_target(self, target: Target) -> bool:
        """Take a frame's measurement; tell whether it was one that counts."""
        pose = self._poses.get(target.stamp_ns)
        if not target.measured or target.tree_id is None or pose is None:
            return False
        if target.map_id != self._map_id or pose.map_id != self._map_id or pose.keyframe_id is None:
            return False
        view = _view_of(target, pose)
        if view is None:
            return False
        views = self._views.setdefault(target.tree_id, OrderedDict())
        known = views.get(pose.keyframe_id)
        if known is not None:
            known.take(view)
            return True
        views[pose.keyframe_id] = view
        while len(views) > self._config.max_views:
            views.popitem(last=False)
        return True

    def corrected(self, tree: Tree, keyframes: dict[int, Floats]) -> Tree:
        """Return the tree with the refiner's word; ``keyframes``: their present poses, (4, 4) T_map_keyframe by id."""
        config = self._config
        views = [
            (view, keyframes[keyframe_id])
            for keyframe_id, view in self._views.get(tree.id, {}).items()
            if view.frames >= config.min_frames and keyframe_id in keyframes
        ]
        if not views:
            return tree
        information, weighted = np.zeros((2, 2)), np.zeros(2)
        radius_information, radius_weighted = 0.0, 0.0
        for view, T in views:
            place = T[:3, :3] @ view.place_m + T[:3, 3]
            shift = place[:2] - _axis_at(tree, float(place[2]))
            if float(np.hypot(*shift)) > config.max_shift_m or abs(view.radius_m - tree.radius_m) > config.max_radius_m:
                continue
            own = np.linalg.inv(view.covariance_m2)
            information += own
            weighted += own @ shift
            radius_information += 1.0 / view.radius_m2
            radius_weighted += view.radius_m / view.radius_m2
        if radius_information == 0.0:
            return tree
        covariance = np.linalg.inv(information)
        refined = covariance + np.eye(2) * config.common_xy_m**2
        radius_variance = 1.0 / radius_information + config.common_radius_m**2
        return _fused(
            tree, covariance @ weighted, refined, radius_weighted / radius_information, radius_variance, config
        )


def _view_of(target: Target, pose: Pose) -> View | None:
    if target.position_map_m is None or target.covariance_map_m2 is None or target.raw_radius_m is None:
        return None
    if pose.T_map_camera is None or pose.T_keyframe_camera is None or not target.sigma_radius_m:
        return None
    T_map_camera = from_transform(pose.T_map_camera)
    place = np.array([*target.position_map_m, T_map_camera[2, 3], 1.0])
    in_keyframe = (from_transform(pose.T_keyframe_camera) @ inverse(T_map_camera) @ place)[:3]
    xx, xy, yy = target.covariance_map_m2
    if xx * yy - xy * xy <= 0.0:
        return None
    covariance = np.array([[xx, xy], [xy, yy]])
    return View(1, in_keyframe, covariance, target.raw_radius_m, target.sigma_radius_m**2)


def _axis_at(tree: Tree, z_m: float) -> Floats:
    ax, ay, az = tree.axis
    along = (z_m - tree.z_m) / max(az, 0.1)
    return np.array([tree.x_m + along * ax, tree.y_m + along * ay])


def _fused(
    tree: Tree, shift_m: Floats, shift_m2: Floats, radius_m: float, radius_m2: float, config: FusionConfig
) -> Tree:
    """Return the tree moved by the part of the shift that the two covariances give the refiner."""
    cloud = np.eye(2) * max(tree.sigma_xy_m, config.cloud_xy_m) ** 2
    gain = cloud @ np.linalg.inv(cloud + shift_m2)
    moved = gain @ shift_m
    covariance = (np.eye(2) - gain) @ cloud
    cloud_radius_m2 = max(tree.sigma_radius_m, config.cloud_radius_m) ** 2
    share = cloud_radius_m2 / (cloud_radius_m2 + radius_m2)
    radius = tree.radius_m + share * (radius_m - tree.radius_m)
    sigma_xy = float(np.sqrt(np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[-1]))
    sigma_radius = float(np.sqrt((1.0 - share) * cloud_radius_m2))
    return tree.model_copy(update={
        "x_m": tree.x_m + float(moved[0]), "y_m": tree.y_m + float(moved[1]), "radius_m": radius,
        # the cloud was made with the same poses by the same sensor: what views share, the two share as well
        "sigma_xy_m": min(tree.sigma_xy_m, max(sigma_xy, config.common_xy_m)),
        "sigma_radius_m": min(tree.sigma_radius_m, max(sigma_radius, config.common_radius_m)),
        "suitable": tree.suitable and MIN_SUITABLE_RADIUS_M <= radius <= MAX_SUITABLE_RADIUS_M,
    })  # fmt: skip
