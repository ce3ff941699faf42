"""Fusion itself: slam's places of one or two cameras, IMU and GPS in; the first camera's pose in slam's map out.

While the first camera is located its pose *is* slam's, byte for byte: nothing that GPS or IMU say moves it. What they move
is the smoother's world W, which is odometry. When slam is lost the pose is the last located one carried on by the motion in
W since then, with that motion's joint covariance, and for so long as ``config`` allows. See docs/decisions/fusion.md.
"""

from __future__ import annotations

import numpy as np

from schemas.fusion import Carrier
from services.common.geometry import Matrix, inverse
from services.fusion.anchor import Anchor
from services.fusion.config import FusionConfig
from services.fusion.gps import GpsDesk
from services.fusion.guard import Guard
from services.fusion.inertial import IMU_LATE_NS, Inertial
from services.fusion.second_eye import SecondEye
from services.fusion.sight import Sight
from services.fusion.smoother import Smoother, State
from services.fusion.values import (
    Fused,
    GpsReading,
    ImuReading,
    Located,
    Moved,
    relative,
)

_TIE = np.diag(np.repeat([0.02**2, 0.05**2], 3))
"""What a place found again adds to the doubt of the step over the gap: it may be another tree that looks the same."""
_RIPE_S = 1.0
"""Velocity and bias are known after this; before, the IMU contradicts nobody."""
_WALK_M_S = 1.0
_NONE = -1
_IMU_BEGIN_NS, _IMU_BACK_NS = 50_000_000, 300_000_000
"""An IMU that has told so much without a gap is begun with, or taken in again."""


class Fuser:
    """One flight. Pure but for gtsam: the same inputs give the same outputs."""

    def __init__(self, config: FusionConfig, T_body_camera: Matrix, T_body_second: Matrix | None = None) -> None:
        self.config = config
        self._T_body_camera = T_body_camera
        self.inertial = Inertial(config.imu_noise)
        self.gps: GpsDesk | None = GpsDesk(config) if config.gps else None
        self.smoother: Smoother | None = None
        self.restarts = self.jumps_announced = 0
        self.resets = 0
        """Added to slam's own reset counter: jumps that slam did not tell."""
        self._anchor: Anchor | None = None
        self.guard = Guard(config, T_body_camera)
        self._pending: Located | None = None
        """A frame that is to become a state once the IMU has told of its time."""
        self._first = Sight()
        self._eye = None if T_body_second is None else SecondEye(T_body_second)
        self._began_ns = -1
        self._blind = True
        self._pace = Moved(np.eye(4), _TIE)
        """The last step that the first camera told."""

    # -- in -----------------------------------------------------------------------------------------------------
    def imu(self, reading: ImuReading) -> None:
        """Take an IMU reading."""
        if self.config.imu:
            self.inertial.add(reading)

    def fix(self, reading: GpsReading) -> None:
        """Take a fix."""
        if self.gps is not None:
            self.gps.take(reading)

    def camera(self, stamp_ns: int, located: Located | None) -> Fused | None:
        """Take a frame of the first camera, located or not; return the pose to tell, None when there is none."""
        self._first.take(stamp_ns, located)
        if self.smoother is None:
            return None if located is None else self._begin(located)
        if stamp_ns <= self.smoother.last.stamp_ns:
            return self._as_told(located)
        self._catch_up()
        if not self._felt(stamp_ns):
            late = self.smoother.inertial and self._imu_wanted(stamp_ns)
            late = late and stamp_ns - self.inertial.newest_ns < IMU_LATE_NS
            return self._late(located) if late else self._restart(located)
        if located is not None and self._contradicted(located):
            return self._near(self._carry(stamp_ns))
        if located is not None:
            return self._follow(located)
        if not self.smoother.inertial:
            self._go_blind()
            return None
        return self._carry(stamp_ns)

    def second(self, stamp_ns: int, located: Located | None) -> Fused | None:
        """Take a frame of the second camera; a pose is returned only where it alone tells the motion (no IMU)."""
        s, eye = self.smoother, self._eye
        if eye is None:
            return None
        eye.take(stamp_ns, located)
        if located is None or s is None:
            return None
        eye.join(s)
        lost = self._first.newest_ns >= stamp_ns and self._first.at(stamp_ns) is None
        if s.inertial or stamp_ns <= s.last.stamp_ns or not lost:
            return None
        step = eye.step(s, located)
        return None if step is None else self._told_at(s.step(stamp_ns, step))

    def silence(self, stamp_ns: int) -> Fused | None:
        """Return the pose at a moment for which no frame came, carried on by the IMU."""
        s = self.smoother
        if s is None or not s.inertial or stamp_ns <= s.last.stamp_ns:
            return None
        return self._carry(stamp_ns) if self.inertial.covers(s.last.stamp_ns, stamp_ns) else None

    def _late(self, located: Located | None) -> Fused | None:
        """Tell a pose at once although the IMU's samples of that moment are still to come."""
        if located is None:
            return self.silence(self.inertial.newest_ns)
        if self._contradicted(located):  # by the samples that are there, the last of them going on
            return self._near(self.silence(self.inertial.newest_ns))
        self._pending = located
        return self._as_told(located)

    def _near(self, carried: Fused | None) -> Fused | None:
        """Return the pose that is carried on against slam's word, as long as the two are not too far apart."""
        return carried if self.guard.apart_m <= self.config.apart_m else None

    def _catch_up(self) -> None:
        """Make a state of the frame that was too early for the IMU."""
        pending, self._pending = self._pending, None
        s = self.smoother
        if (
            pending is not None
            and s is not None
            and pending.stamp_ns > s.last.stamp_ns
            and self._felt(pending.stamp_ns)
        ):
            self._follow(pending)

    def _felt(self, stamp_ns: int) -> bool:
        """Whether the window can go on to a moment: the IMU has told all of the time, or none of it is looked for."""
        s = self.smoother
        assert s is not None
        if s.inertial:
            return self._imu_wanted(stamp_ns) and self.inertial.covers(s.last.stamp_ns, stamp_ns)
        return not (self._imu_wanted(stamp_ns) and self.inertial.flows(stamp_ns, _IMU_BACK_NS))

    def _imu_wanted(self, stamp_ns: int) -> bool:
        return self.config.imu and stamp_ns >= self.guard.banned_until_ns

    # -- the located camera -------------------------------------------------------------------------------------
    def _begin(self, located: Located, T_W_body: Matrix | None = None, velocity: Matrix | None = None) -> Fused:
        """Start a window at a located frame; W is the map, or goes on where the last window ended."""
        with_imu = self._imu_wanted(located.stamp_ns) and self.inertial.flows(located.stamp_ns, _IMU_BEGIN_NS)
        s = Smoother(self.config, self.inertial if with_imu else None)
        if T_W_body is None:
            T_W_body = located.T_map_camera @ inverse(self._T_body_camera)
        tilt = max(0.03, float(np.sqrt(located.covariance.diagonal()[3:5].max())))
        s.begin(located.stamp_ns, T_W_body, tilt, velocity)
        self.smoother, self._anchor = s, Anchor(0, located)
        self._began_ns = located.stamp_ns
        if self._eye is not None:
            self._eye.begin()
        self.guard.begin()
        self._solve()
        return self._as_told(located)  # type: ignore[return-value]

    def _restart(self, located: Located | None) -> Fused | None:
        """Begin a new window where the map says that the old one has got to: the IMU's readings have a gap."""
        if located is None or self.smoother is None:
            return None
        self.restarts += 1
        return self._begin(located, self._reached(located))

    def _reached(self, located: Located) -> Matrix | None:
        """Return ``T_W_body`` at a located frame through the map, from the last located state."""
        anchor, s = self._anchor, self.smoother
        if anchor is None or s is None:
            return None
        T = s.state(anchor.index).T_W_body if s.holds(anchor.index) else s.last.T_W_body
        if anchor.located.epoch[0] != located.epoch[0]:
            self._unknown_way((located.stamp_ns - anchor.located.stamp_ns) * 1e-9 * _WALK_M_S)
            return T
        return T @ relative(anchor.located, located, self._T_body_camera).T

    def _follow(self, located: Located) -> Fused | None:
        """Go on with a located frame; a state is made of it when one is due."""
        s, anchor = self._window()
        due = located.stamp_ns - s.last.stamp_ns >= self.config.state_s * 1e9
        same = anchor.located.epoch == located.epoch and anchor.index == s.last.index
        if not (due or self._blind or not same):
            return self._as_told(located)
        if not same and not s.inertial and anchor.located.epoch[0] != located.epoch[0]:
            return self._restart(located)
        step = self._step(s, anchor, located, same=same)
        state = s.step(located.stamp_ns, step)
        if step is not None:
            s.join(anchor.index, state.index, step, robust=not same)
        self._anchor, self._blind = Anchor(state.index, located), False
        if not self._settle(seen=True):
            return self._begin(located, state.T_W_body)
        return self._as_told(located)

    def _step(self, s: Smoother, anchor: Anchor, located: Located, *, same: bool) -> Moved | None:
        """Return how the body moved since the last located state, as far as the map can tell; None: the IMU alone knows.

        A place found again in the same map is one, with doubt. A map that slam has corrected says nothing of the way in
        between: without IMU the aircraft is taken to have gone on as before.
        """
        step = relative(anchor.located, located, self._T_body_camera)
        if same:
            self._pace = step
            return step
        if self._blind and anchor.located.epoch[0] == located.epoch[0] and s.holds(anchor.index):
            return Moved(step.T, step.covariance + _TIE)
        return None if s.inertial else Moved(self._pace.T, self._pace.covariance + _TIE)

    def _contradicted(self, located: Located) -> bool:
        """Whether the IMU says that the camera cannot be where slam says; what slam keeps to is believed in the end."""
        s, anchor = self._window()
        ripe = s.inertial and (located.stamp_ns - self._began_ns) * 1e-9 >= _RIPE_S
        told = located.epoch[1] != anchor.located.epoch[1] and not self._blind
        if not ripe or told or located.epoch[0] != anchor.located.epoch[0] or not s.holds(anchor.index):
            return False
        verdict = self.guard.judge(s, anchor.index, anchor.located, located)
        if verdict == "taken":
            untold = located.epoch == anchor.located.epoch
            self.resets += untold
            self.jumps_announced += untold
            self._anchor = Anchor(_NONE, located)  # nothing joins the two places
        return verdict == "refused"

    # -- without the first camera -------------------------------------------------------------------------------
    def _carry(self, stamp_ns: int) -> Fused | None:
        """Carry the last located pose on to a moment."""
        assert self.smoother is not None
        return self._told_at(self.smoother.step(stamp_ns))

    def _go_blind(self) -> None:
        """Note that the first camera is lost: what it sees next is a step over the gap, not one frame's."""
        _, anchor = self._window()
        if not self._blind and self.gps is not None:
            self.gps.blind(anchor.located.stamp_ns)
        self._blind = True

    def _told_at(self, state: State) -> Fused | None:
        s, anchor = self._window()
        self._go_blind()
        s.keep(anchor.index)
        if not self._settle(seen=self._second_sees(state.stamp_ns)):
            return None
        carrier: Carrier = "second" if self._second_sees(state.stamp_ns) else "imu"
        if not (s.holds(anchor.index) and anchor.reaches(state.stamp_ns, carrier, self.config)):
            return None
        moved = s.moved(anchor.index, state.index)
        return anchor.told(state.stamp_ns, carrier, moved, self._T_body_camera, self.config)

    def _second_sees(self, stamp_ns: int) -> bool:
        return self._eye is not None and self._eye.sees(stamp_ns)

    # -- the window ---------------------------------------------------------------------------------------------
    def _settle(self, *, seen: bool) -> bool:
        """Join what else is known of the states and solve; False when the window broke and a new one is needed."""
        s = self.smoother
        assert s is not None
        if self._eye is not None:
            self._eye.join(s)
        if self.gps is not None:
            for placement in self.gps.due(s.states, seen=seen):
                if s.holds(placement.index):
                    antenna = np.asarray(self.config.gps_noise.antenna_m)
                    s.place(placement.index, placement.position_W_m, placement.covariance, antenna)
        return self._solve()

    def _window(self) -> tuple[Smoother, Anchor]:
        """Return both, once there are any."""
        assert self.smoother is not None
        assert self._anchor is not None
        return self.smoother, self._anchor

    def _solve(self) -> bool:
        s = self.smoother
        assert s is not None
        try:
            s.solve()
        except RuntimeError:  # gtsam's: an indeterminate window
            self.restarts += 1
            self.smoother = None
            return False
        return True

    def _unknown_way(self, by_m: float) -> None:
        if self.gps is not None:
            self.gps.geo.shift_world(by_m)

    def _as_told(self, located: Located | None) -> Fused | None:
        if located is None:
            return None
        return Fused(located.stamp_ns, located.T_map_camera, located.covariance, "camera")

    # -- what else is known -------------------------------------------------------------------------------------
    def on_earth(self) -> tuple[Matrix, Matrix, float] | None:
        """Return the body's place (east, north, up), its attitude on the earth (3, 3), and its horizontal sigma."""
        return None if self.gps is None or self.smoother is None else self.gps.on_earth(self.smoother.last.T_W_body)

    @property
    def bias(self) -> tuple[Matrix, Matrix]:
        """The IMU's bias as estimated."""
        return (np.zeros(3), np.zeros(3)) if self.smoother is None else self.smoother.bias
