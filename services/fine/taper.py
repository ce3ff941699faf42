"""The taper function through a stem's sections, and how sure an estimate is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.fine.model import BREAST_HEIGHT_M, Floats

_TUKEY = 4.0


def jackknife_sigma(values: Floats) -> float:
    """Return the standard deviation of an estimate from its values with each of n groups left out."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.sum((values - values.mean()) ** 2)))


def fit_taper(height_m: Floats, radius_m: Floats, weight: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return (radius at 1.3 m, its change per metre) of a line through sections, and which of them it took for good.

    Iteratively reweighted (Tukey's biweight): a branch whorl or a hidden height does not pull it. The change has a weak
    prior about -6 mm a metre, so that a short piece of stem does not extrapolate wildly.
    """
    x = height_m - BREAST_HEIGHT_M
    held = weight > 0.0
    robust = weight.copy()
    line = np.array([float(np.median(radius_m[held])), -0.006])
    for _ in range(15):
        A = np.array([[robust.sum(), (robust * x).sum()], [(robust * x).sum(), (robust * x * x).sum() + 1.0 / 0.02**2]])
        y = np.array([(robust * radius_m).sum(), (robust * x * radius_m).sum() - 0.006 / 0.02**2])
        line = np.linalg.solve(A, y)
        off = (radius_m - line[0] - line[1] * x) * np.sqrt(weight)
        spread = max(1.0, 1.4826 * float(np.median(np.abs(off[held]))))
        t = off / (_TUKEY * spread)
        robust = np.where(np.abs(t) < 1.0, weight * (1.0 - t * t) ** 2, 0.0)
        if not np.count_nonzero(robust):
            robust = weight.copy()
    return line, robust > 0.0


def agreed(fine_m: float, fine_sigma_m: float, live_m: float, live_sigma_m: float) -> tuple[float, float]:
    """Return by how much the live radius moves the fine one, and the doubt of what comes out.

    What is wrong with the sections of a one-sided stem is mostly common to all of them: the axis stands too far or too near
    along the ray. The live radius knows something of that which clouds do not, the stem's silhouette (the refiner). The two
    share frames, so how far their errors are alike is not known: covariance intersection (Julier and Uhlmann, 1997), with
    the weights of independent errors, claims no more than either is sure of.
    """
    fine2, live2 = fine_sigma_m**2, max(live_sigma_m, 1e-4) ** 2
    share = fine2 / (fine2 + live2)
    combined2 = 1.0 / (share / live2 + (1.0 - share) / max(fine2, 1e-8))
    return share * (live_m - fine_m), float(np.sqrt(combined2))
