"""The mission put into messages: guidance for the bridge, state for everybody. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.navigation import Guidance, MissionState, MissionStateName, Setpoint
from services.common.geometry import Matrix, wrap_angle
from services.navigator.board import Board
from services.navigator.values import Intent

_MAX_REASON = 500
_HELD: frozenset[MissionStateName] = frozenset({"dock", "docked"})
_LEAN_M, _AGAINST_M_S = 0.15, 0.15
_CARRY_NS = 250_000_000


@dataclass(frozen=True, slots=True)
class Telling:
    """Where the mission stands at one step."""

    state: MissionStateName
    previous: MissionStateName
    since_ns: int
    reason: str
    mission_id: int
    seq: int
    failsafe: str

    def guidance(self, b: Board, intent: Intent) -> Guidance:
        """Return the command with its magnitude and the setpoint that carries it out.

        Without a pose there is no setpoint: the bridge then holds by itself.
        """
        t, last = b.trajectory, b.track.latest
        setpoint = None
        if last is not None and t.placed:
            position, velocity = (
                stiffened(b) if self.state in _HELD and intent.motion == "aim" else (t.position_m, t.velocity_m_s)
            )
            setpoint = Setpoint(
                position_m=_vec(position), yaw_rad=wrap_angle(t.yaw_rad), velocity_m_s=_vec(velocity),
                yaw_rate_rad_s=float(t.yaw_rate_rad_s),
            )  # fmt: skip
        return Guidance(
            stamp_ns=b.now_ns, seq=self.seq, map_id=last.map_id if last else "none", command=intent.command,
            magnitude=float(max(intent.magnitude, 0.0)), unit=intent.unit,
            engage=intent.engage and not b.config.handheld, land=intent.land, mission_id=self.mission_id,
            reset_counter=last.reset_counter if last else 0, setpoint=setpoint, reason=self.reason[:_MAX_REASON],
        )  # fmt: skip

    def state_message(self, b: Board) -> MissionState:
        """Return the state with its reason and what is believed of the target."""
        seen = b.to_axis() if b.target_id is not None else None
        return MissionState(
            stamp_ns=b.now_ns, seq=self.seq, map_id=b.track.latest.map_id if b.track.latest else "none",
            state=self.state, previous=self.previous, since_ns=self.since_ns, reason=self.reason[:_MAX_REASON],
            target_tree_id=b.target_id, visited_tree_ids=tuple(b.visited_ids), docked_count=b.docked_count,
            distance_m=None if seen is None else float(seen[0]),
            heading_error_rad=None if seen is None else float(seen[1]), failsafe=self.failsafe,
        )  # fmt: skip


def stiffened(b: Board) -> tuple[Matrix, Matrix]:
    """Return place and velocity (3,) of the setpoint, leant against gusts while docked or docking.

    The autopilot answers a place error with its own gain. Asking for a place beyond the one wanted by a share of the
    error, and for a velocity against the present one by the same share, acts as gains higher by that share. Level only,
    and never beyond the limits of speed and fence.
    """
    t, share = b.trajectory, b.config.dock.stiffness
    if b.here is None or share == 0.0:
        return t.position_m, t.velocity_m_s
    T = b.track.predict(min(b.now_ns, b.here.stamp_ns + _CARRY_NS))
    lean, against = share * (t.position_m - T[:3, 3]), share * (t.velocity_m_s - b.track.velocity_m_s)
    lean[2] = against[2] = 0.0
    position = t.position_m + _clipped(lean, _LEAN_M)
    if t.fence is not None and t.fence.excess_m(t.position_m) == 0.0:
        position = t.fence.clamp(position)
    return position, _clipped(t.velocity_m_s + _clipped(against, _AGAINST_M_S), t.limits.max_speed_m_s)


def _clipped(v: Matrix, limit: float) -> Matrix:
    norm = float(np.linalg.norm(v))
    return v if norm <= limit else v * (limit / norm)


def _vec(v: Matrix) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
