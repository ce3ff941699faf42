"""What the depth images say about the map's trees: a shift and a radius per tree, fused by covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.detector.refine.model import ExpectedTree, Matrix, Measurement, inverse_2x2, largest_eigenvalue_2x2

_DRIFT_M = 0.003
"""Per measurement: pose and map drift against each other, so old measurements fade."""
_MIN_SIGMA_M = 0.01
_MIN_SIGMA_RADIUS_M = 0.003


@dataclass(frozen=True, slots=True)
class Correction:
    """A tree's place and radius, measured less mapped."""

    shift_m: Matrix
    covariance: Matrix
    radius_m: float
    radius_variance: float

    @classmethod
    def none(cls, tree: ExpectedTree) -> Correction:
        """Return the map's own word."""
        sigma = max(tree.sigma_xy_m, _MIN_SIGMA_M)
        return cls(np.zeros(2), np.eye(2) * sigma**2, 0.0, max(tree.sigma_radius_m, _MIN_SIGMA_RADIUS_M) ** 2)

    def fused(self, measured: Measurement, tree: ExpectedTree) -> Correction:
        """Return the correction after a measurement made with ``applied(tree)`` as the expected tree."""
        P = self.covariance + np.eye(2) * _DRIFT_M**2
        gain = P @ inverse_2x2(P + measured.covariance_map_m2)
        variance = self.radius_variance + (0.1 * _DRIFT_M) ** 2
        weight = variance / (variance + float(measured.covariance[2, 2]))
        radius = self.radius_m + weight * (measured.radius_m - tree.radius_m - self.radius_m)
        return Correction(
            self.shift_m + gain @ np.asarray(measured.shift_m),
            (np.eye(2) - gain) @ P,
            radius,
            (1.0 - weight) * variance,
        )

    def rebased(self, before: ExpectedTree, after: ExpectedTree) -> Correction:
        """Return the correction of the same tree newly mapped: place and radius as corrected stay what they are.

        The new list may hold what was measured here (the detector fuses it): added once more it would count double.
        """
        shift = self.shift_m - np.array([after.x_m - before.x_m, after.y_m - before.y_m])
        return replace(self, shift_m=shift, radius_m=self.radius_m - (after.radius_m - before.radius_m))

    def applied(self, tree: ExpectedTree) -> ExpectedTree:
        """Return the map's tree with the correction."""
        sigma = float(np.sqrt(max(largest_eigenvalue_2x2(self.covariance), _MIN_SIGMA_M**2)))
        return replace(
            tree, x_m=tree.x_m + float(self.shift_m[0]), y_m=tree.y_m + float(self.shift_m[1]), sigma_xy_m=sigma,
            radius_m=max(tree.radius_m + self.radius_m, 0.01),
            sigma_radius_m=max(float(np.sqrt(self.radius_variance)), _MIN_SIGMA_RADIUS_M),
        )  # fmt: skip
