"""Where corners lie does not depend on the level of the pyramid that they are found in."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.slam.detect import Detector

WIDTH, HEIGHT = 640, 480
PLACES = np.stack(np.meshgrid(np.arange(50.0, 620.0, 30.0), np.arange(50.0, 460.0, 30.0)), axis=-1).reshape(-1, 2)
PLACES += np.random.default_rng(1).integers(-7, 8, PLACES.shape)  # else all have the same place among a level's pixels


def spots() -> NDArray[np.uint8]:
    """Dark spots of many sizes, symmetric: each is a corner at its middle."""
    out = np.full((HEIGHT, WIDTH), 200.0)
    v, u = np.mgrid[-14:15, -14:15]
    for k, (x, y) in enumerate(PLACES.astype(int)):
        sigma = 1.0 + 0.7 * (k % 7)
        out[y - 14 : y + 15, x - 14 : x + 15] -= 150.0 * np.exp(-0.5 * (u**2 + v**2) / sigma**2)
    return out.astype(np.uint8)


@pytest.mark.parametrize("octave", range(8))
def test_corners_of_each_level_lie_where_they_are_all_over_the_image(octave: int) -> None:
    depth_m = np.ones((HEIGHT, WIDTH), np.float32)
    _, (xy, _, _, octaves) = Detector(3000, 8, 1.2, 19, 7).detect(spots(), depth_m)
    places = xy[octaves == octave]
    off = places[:, None, :] - PLACES[None]
    nearest = off[np.arange(len(off)), np.argmin((off**2).sum(axis=2), axis=1)]
    near = np.linalg.norm(nearest, axis=1) < 1.5 * 1.2**octave
    assert np.count_nonzero(near) >= 8
    far_side = places[near] > [0.6 * WIDTH, 0.6 * HEIGHT]
    for axis in (0, 1):
        assert far_side[:, axis].any()
        assert abs(np.median(nearest[near][far_side[:, axis], axis])) < 0.3
