"""Obstacles on the way, as a failsafe: what is braked for, and when it may go on. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.navigation import MissionStateName
from services.common.geometry import Matrix
from services.navigator.board import Board
from services.navigator.path import clearance_m
from services.navigator.routing import moving_into, retreat, seen_free_m, way_round

MOVING_M_S = 0.05
GUARDED: frozenset[MissionStateName] = frozenset({"approach", "dock", "undock", "return"})
_BODY_MARGIN_M = 0.10
_REACTION_S = 0.5
_ASK_ROUND_NS, _WAIT_NS = 250_000_000, 1_500_000_000
"""How often a way round is looked for, and how long what stands in the way is waited for first."""


def braking_m(b: Board, speed_m_s: float) -> float:
    """Return the way that it takes to come to rest, reaction included."""
    return speed_m_s * _REACTION_S + speed_m_s * speed_m_s / b.config.motion.max_accel_m_s2


@dataclass
class Block:
    """What is braked for, while the way is blocked."""

    way: Matrix | None = None
    """Direction (2,) in map in which the aircraft braked."""
    _word: str = ""
    _since_ns: int = 0
    _asked_ns: int = 0
    """When a way round was looked for last."""
    _retreat: Matrix | None = None
    """Where to give way to, chosen once: whoever follows is not run away from."""

    def retreat(self, b: Board) -> Matrix | None:
        """Return the place (2,) to give way to while something is too near, or None."""
        if self._retreat is None:
            self._retreat = retreat(b)
        return self._retreat

    def still(self, b: Board, doing: MissionStateName) -> str:
        """Return why the way that was braked on cannot be gone on; empty when it can, or when there is one round."""
        assert self.way is not None
        if b.now_ns < self._asked_ns + _ASK_ROUND_NS:
            return self._word
        self._asked_ns = b.now_ns
        waited = b.now_ns - self._since_ns >= _WAIT_NS
        round_it = way_round(b, doing) if waited else False
        straight = seen_free_m(b, self.way) >= b.config.safety_radius_m
        ahead = self.way * b.config.approach_speed_m_s
        if round_it or (round_it is None and straight and moving_into(b, ahead) is None):
            self.way, self._retreat, b.planned_ns = None, None, -1
            return ""
        return self._word

    def by(self, b: Board, doing: MissionStateName, velocity_m_s: Matrix) -> str:
        """Return what stands or comes in the way within the braking distance, empty when nothing does."""
        assert b.here is not None
        speed = float(np.linalg.norm(velocity_m_s))
        mover = moving_into(b, velocity_m_s) if doing in GUARDED else None
        if mover is not None:
            word = f"something moves into the way at {float(np.hypot(*mover.state[2:])):.1f} m/s"
            return self._remember(velocity_m_s / speed if speed > MOVING_M_S else _ahead(b), word, b.now_ns)
        if speed < MOVING_M_S:
            return ""
        if seen_free_m(b, velocity_m_s) < b.config.aircraft_radius_m + _BODY_MARGIN_M + braking_m(b, speed):
            return self._remember(velocity_m_s / speed, "something stands in the way", b.now_ns)
        here = b.here.position_m[:2]
        discs = b.discs(b.config.aircraft_radius_m + _BODY_MARGIN_M)
        now, then = clearance_m(here, discs), clearance_m(here + velocity_m_s, discs)
        return "a trunk stands in the way" if then < 0.0 and then < now else ""

    def _remember(self, way: Matrix, word: str, now_ns: int) -> str:
        self.way, self._word, self._since_ns, self._asked_ns = way, word, now_ns, now_ns
        return word


def _ahead(b: Board) -> Matrix:
    assert b.here is not None
    return np.array([np.cos(b.here.yaw_rad), np.sin(b.here.yaw_rad)])
