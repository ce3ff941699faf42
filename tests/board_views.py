"""Renders pictures of calibration boards with a known camera."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from services.camera.calibration.board import Board

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

SIZE = (480, 360)
K = np.array([[391.0, 0.0, 243.5], [0.0, 388.0, 176.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([0.12, -0.25, 0.001, -0.0015, 0.08])
_TEXTURE_PX = 40
_SUPER = 2


@lru_cache(maxsize=2)
def _rays() -> Floats:
    """Return (H * s, W * s, 2) of x/z, y/z of each sample's ray, s by s samples in a pixel."""
    u = (np.arange(SIZE[0] * _SUPER) + 0.5) / _SUPER - 0.5
    v = (np.arange(SIZE[1] * _SUPER) + 0.5) / _SUPER - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    rays = cv2.undistortPoints(pixels, K, DISTORTION, None, None, None, criteria)
    return np.asarray(rays, dtype=np.float64).reshape(SIZE[1] * _SUPER, SIZE[0] * _SUPER, 2)


def board_at(x_m: float, y_m: float, z_m: float, turn: float = 0.0, tip: float = 0.0, roll: float = 0.0) -> Floats:
    """Return ``T_camera_board`` of a board about its centre; angles in radians."""
    R = np.eye(3)
    for axis, angle in ((1, turn), (0, tip), (2, roll)):
        vector = np.zeros(3)
        vector[axis] = angle
        R = R @ np.asarray(cv2.Rodrigues(vector)[0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, (x_m, y_m, z_m)
    return T


def render(board: Board, T_camera_board: Floats, seed: int = 0, blur_px: float = 0.5, noise: float = 2.0) -> Grey:
    """Return a picture (H, W) of the board, supersampled, blurred, with noise."""
    texture = board.picture(_TEXTURE_PX).astype(np.float32)
    rays = np.concatenate([_rays(), np.ones((*_rays().shape[:2], 1))], axis=-1)
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    # ray s * d meets the board's plane (z = 0 of the board) where (R^T (s d - t))_z = 0
    directions, origin = rays @ R, R.T @ t
    s = origin[2] / directions[..., 2]
    on_board = directions[..., :2] * s[..., None] - origin[:2]
    size = np.array([texture.shape[1], texture.shape[0]])
    at = on_board / board.square_m * _TEXTURE_PX + size / 2.0 - 0.5
    at[s <= 0.0] = -1e6
    sampled = cv2.remap(
        texture, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=90.0,
    )  # fmt: skip
    small = cv2.resize(sampled, SIZE, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(0.8 * small + 20.0, (0, 0), blur_px)
    noisy = small + np.random.default_rng(seed).normal(0.0, noise, small.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def good_poses() -> list[Floats]:
    """Return poses all over the picture, turned and tipped."""
    out = []
    for k in range(12):
        angle = 2.4 * k  # the golden angle: all round
        reach = 0.055 if k % 2 else 0.03
        turn, tip = 0.55 * np.cos(1.7 * k + 0.7), 0.5 * np.sin(2.9 * k + 0.3)
        out.append(
            board_at(
                1.3 * reach * np.cos(angle), reach * np.sin(angle), 0.30 + 0.02 * (k % 4), turn, tip, 0.15 * np.sin(k)
            )
        )
    return out


@lru_cache(maxsize=2)
def good_views(kind: str) -> tuple[Grey, ...]:
    """Return pictures of a board of this kind at the good poses."""
    board = Board(kind="charuco") if kind == "charuco" else Board()
    return tuple(render(board, T, k) for k, T in enumerate(good_poses()))
