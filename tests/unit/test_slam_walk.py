"""The rendered walk's file: an interrupted rendering is gone on with."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from zstandard import ZstdCompressor

from services.evaluate.slam_walk import read_walk, trim_walk


def _frame(number: int) -> bytes:
    jpeg = cv2.imencode(".jpg", np.full((6, 8), 40 * number, np.uint8))[1].tobytes()
    depth = ZstdCompressor().compress(np.full((6, 8), 1000 * number, np.uint16).tobytes())
    sizes = np.array([len(jpeg), len(depth)], np.uint32).tobytes()
    return sizes + (number * np.eye(4)).tobytes() + jpeg + depth


@pytest.mark.parametrize("left", [0, 3, 100, 140])
def test_a_half_frame_at_the_end_is_cut_off(tmp_path: Path, left: int) -> None:
    path, whole = tmp_path / "walk.part", _frame(1) + _frame(2)
    path.write_bytes(whole + _frame(3)[:left])
    assert trim_walk(path) == 2
    assert path.read_bytes() == whole


def test_a_trimmed_walk_is_read(tmp_path: Path) -> None:
    path = tmp_path / "walk.part"
    path.write_bytes(_frame(1) + _frame(2)[:-1])
    assert trim_walk(path) == 1
    frames = list(read_walk(path))
    assert [frame.index for frame in frames] == [0]
    assert frames[0].depth_m.shape == (12, 16)
    np.testing.assert_allclose(frames[0].depth_m, 1.0)


def test_no_file_is_no_frame(tmp_path: Path) -> None:
    assert trim_walk(tmp_path / "walk.part") == 0
