"""The last place at which the first camera was located, and how far it may be carried on from there. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.fusion import Carrier
from services.common.geometry import Matrix, inverse
from services.fusion.config import FusionConfig
from services.fusion.values import Fused, Located, Moved, adjoint, carried


@dataclass(slots=True)
class Anchor:
    """A state of the window, by its index, and what slam said there."""

    index: int
    located: Located

    def carried_by(self, moved: Moved, T_body_camera: Matrix) -> tuple[Matrix, Matrix]:
        """Return the first camera's pose and covariance in the map after the body ``moved`` from here."""
        A = adjoint(inverse(T_body_camera))
        T = inverse(T_body_camera) @ moved.T @ T_body_camera
        return carried(self.located, T, A @ moved.covariance @ A.T)

    def reaches(self, stamp_ns: int, carrier: Carrier, config: FusionConfig) -> bool:
        """Whether it was not too long ago to be carried on to a moment."""
        limit_s = config.second_alone_s if carrier == "second" else config.imu_alone_s
        return (stamp_ns - self.located.stamp_ns) * 1e-9 <= limit_s

    def told(
        self, stamp_ns: int, carrier: Carrier, moved: Moved, T_body_camera: Matrix, config: FusionConfig
    ) -> Fused | None:
        """Return the pose carried to a moment; None when it is too doubtful."""
        pose, covariance = self.carried_by(moved, T_body_camera)
        if float(np.sqrt(covariance.diagonal()[:3].max())) > config.sigma_m:
            return None
        return Fused(stamp_ns, pose, covariance, carrier)
