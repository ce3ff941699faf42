"""When we may steer the aircraft, and when never again. Pure.

One mission number engages once. Setpoints go out only while engaging or engaged, so that PX4, which goes back to
offboard by itself when a stream resumes, never finds one to go back to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from schemas.navigation import Guidance
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.px4 import LAND, OFFBOARD

Phase = Literal["quiet", "streaming", "switching", "arming", "engaged", "landing", "released"]
Order = Literal["offboard", "arm", "land", "disarm"]

_STREAMING: frozenset[Phase] = frozenset({"streaming", "switching", "arming", "engaged"})
_REPEAT_S = 0.5
_DISARM_AFTER_S = 4.0
_OTHERS_TOLD_S = 3.0
_SEQ_GAP = 100
"""So many messages of one navigator may be lost in a row."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What the engagement needs to know of the vehicle."""

    heard: bool
    """Some message of the autopilot came within ``link_lost_s``."""
    armed: bool
    mode: str
    on_ground: bool
    vision_fused: bool
    refusal: str = ""
    """Why this vehicle must not be flown: a parameter that is not as it has to be."""
    foreign: str = ""
    """Who else is at the controls, in words."""
    arming: str = ""
    """What the autopilot answered when it was asked to arm, in words."""
    failsafe: bool = False
    """The autopilot says of itself that it acts by a failsafe."""
    mode_ns: int = 0
    """When it last told its mode."""


class Engagement:
    """The state machine between our guidance and PX4's modes."""

    def __init__(self, config: AutopilotConfig) -> None:
        self.config = config
        self.phase: Phase = "quiet"
        self.mission_id = 0
        """The last mission that was engaged, or found spent when we were started in the middle of it."""
        self.note = ""
        self._since_ns = 0
        self._asked_ns = 0
        self._guidance: Guidance | None = None
        self._heard_ns = 0
        self._hold_since_ns: int | None = None
        self._ground_since_ns: int | None = None
        self._in_offboard = False
        self._foreign = ""
        self._land_seen = False
        self._mode_ns = 0
        self._just_told = False
        """The mode is of this very moment: a pilot's switch that we do not know of would be overridden by what we ask."""
        self.of_others = 0
        """Guidance of another mission than the one that is flown."""
        self._others_ns: int | None = None
        self._mode_before = ""
        """The mode in which the vehicle stood when we began: the pilot changes it to say no."""

    @property
    def streams(self) -> bool:
        """Whether setpoints may go out."""
        return self.phase in _STREAMING or (self.phase == "landing" and self._in_offboard)

    @property
    def holds(self) -> bool:
        """Whether the aircraft is held although there is guidance: somebody else is at the controls."""
        return bool(self._foreign) and self.phase == "engaged"

    @property
    def override(self) -> bool:
        """Whether the aircraft was taken from us."""
        return self.phase == "released"

    def on_guidance(self, guidance: Guidance, vehicle: Vehicle, now_ns: int) -> None:
        """Take guidance. A new mission engages on the step from engage off to on, seen by us, vehicle disarmed.

        While a mission is flown, guidance of another is a second navigator's: counted, and left alone. So is that of the same
        mission which does not continue what is followed: a navigator that starts in flight adopts what it finds.
        """
        if self.phase not in ("quiet", "released") and self._of_another(guidance, now_ns):
            self.of_others += 1
            self._others_ns = now_ns
            return
        before, self._guidance, self._heard_ns = self._guidance, guidance, now_ns
        if not guidance.engage or guidance.mission_id <= self.mission_id:
            return
        rising = before is not None and (not before.engage or before.mission_id < guidance.mission_id)
        free = self.phase in ("quiet", "released") and vehicle.heard and not vehicle.armed
        self.mission_id = guidance.mission_id
        if rising and free:
            self._mode_before = vehicle.mode
            self._go("streaming", f"engaging for mission {guidance.mission_id}", now_ns)
        else:
            why = "it was under way when the bridge was started" if not rising else "the vehicle is not free"
            self.note = f"mission {guidance.mission_id} is not engaged: {why}"

    def _of_another(self, guidance: Guidance, now_ns: int) -> bool:
        if guidance.mission_id != self.mission_id:
            return True
        followed = self.usable(now_ns)  # None once it is silent: who was started again is heard then
        return followed is not None and not 0 < guidance.seq - followed.seq <= _SEQ_GAP

    def others_word(self, now_ns: int) -> str:
        """Return what is to be told of another navigator that spoke lately, empty when none did."""
        if self._others_ns is None or (now_ns - self._others_ns) / 1e9 > _OTHERS_TOLD_S:
            return ""
        return "a second navigator speaks while the first one flies: stop it"

    def usable(self, now_ns: int) -> Guidance | None:
        """Return the guidance to follow, or None when the aircraft has to hold."""
        g = self._guidance
        if g is None or not g.engage or g.mission_id != self.mission_id:
            return None
        return g if (now_ns - self._heard_ns) / 1e9 <= self.config.guidance_stale_s else None

    def update(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        """Advance, and return the orders to send to the autopilot now."""
        self._in_offboard = vehicle.mode == OFFBOARD
        self._just_told, self._mode_ns = vehicle.mode_ns != self._mode_ns, vehicle.mode_ns
        if self.phase in ("quiet", "released"):
            return []
        if not vehicle.heard:
            self._go("released", "autopilot link lost: PX4 acts by its own failsafe, we stay silent", now_ns)
            return []
        step = {
            "streaming": self._stream, "switching": self._switch, "arming": self._arm, "engaged": self._fly,
            "landing": self._land,
        }[self.phase]  # fmt: skip
        return step(vehicle, now_ns)

    def _refused(self, vehicle: Vehicle) -> bool:
        """Whether the pilot chose another mode while we were asking for offboard, or armed: then he means to fly."""
        return vehicle.mode not in (self._mode_before, OFFBOARD) or vehicle.armed

    def _stream(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        if self._refused(vehicle):
            return self._release(vehicle, now_ns)
        if self.usable(now_ns) is None:
            return self._cancel("the navigator took its order back", now_ns)
        refusal = vehicle.refusal or vehicle.foreign
        ready = vehicle.vision_fused and not refusal
        if ready and self._elapsed_s(now_ns) >= self.config.stream_before_offboard_s:
            self._go("switching", "asking for offboard", now_ns)
        elif self._elapsed_s(now_ns) > self.config.engage_timeout_s:
            return self._cancel(refusal or "the autopilot does not use the vision pose", now_ns)
        return []

    def _switch(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        if self._refused(vehicle):
            return self._release(vehicle, now_ns)
        if self.usable(now_ns) is None:
            return self._cancel("the navigator took its order back", now_ns)
        if vehicle.mode == OFFBOARD:
            self._go("arming", "in offboard, arming", now_ns)
            return self._ask("arm", now_ns)
        if self._elapsed_s(now_ns) > self.config.engage_timeout_s:
            return self._cancel(f"the autopilot stays in {vehicle.mode}", now_ns)
        return self._ask("offboard", now_ns) if self._just_told else []

    def _arm(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        if vehicle.mode != OFFBOARD:
            return self._release(vehicle, now_ns)
        if vehicle.armed:
            self._go("engaged", f"engaged for mission {self.mission_id}", now_ns)
            return []
        if self.usable(now_ns) is None:
            return self._cancel("the navigator took its order back", now_ns)
        if self._elapsed_s(now_ns) > self.config.engage_timeout_s:
            return self._cancel(f"the autopilot refuses to arm{vehicle.arming and ': '}{vehicle.arming}", now_ns)
        return self._ask("arm", now_ns) if self._just_told else []

    def _fly(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        if vehicle.mode != OFFBOARD:
            return self._release(vehicle, now_ns)
        if not vehicle.armed:
            self._go("released", "disarmed, not by us", now_ns)
            return []
        if self._taken_back(now_ns):
            return self._begin_landing("the navigator took its order back: landing", now_ns)
        g = self.usable(now_ns)
        self._foreign = vehicle.foreign
        if g is None or self._foreign:
            why = self._foreign or "no guidance"
            if self._hold_since_ns is None:
                self._hold_since_ns = now_ns
                self.note = f"{why}: holding"
            if (now_ns - self._hold_since_ns) / 1e9 > self.config.guidance_land_s or (g is not None and g.land):
                return self._begin_landing(f"{why}: landing", now_ns)
            return []
        if self._hold_since_ns is not None:
            self.note = f"engaged for mission {self.mission_id}"
        self._hold_since_ns = None
        return self._begin_landing("landing as ordered", now_ns) if g.land else []

    def _taken_back(self, now_ns: int) -> bool:
        """Whether our mission's navigator says, freshly, that nothing is to be flown: it ended it while we were arming."""
        g = self._guidance
        ours = g is not None and g.mission_id == self.mission_id and not g.engage
        return ours and (now_ns - self._heard_ns) / 1e9 <= self.config.guidance_stale_s

    def _begin_landing(self, note: str, now_ns: int) -> list[Order]:
        self._go("landing", note, now_ns)
        self._land_seen = False
        return self._ask("land", now_ns)

    def _land(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        if not vehicle.armed:
            self._go("quiet", "landed and disarmed", now_ns)
            return []
        if vehicle.mode == OFFBOARD and not self._land_seen:
            return self._ask("land", now_ns)
        if vehicle.mode != LAND:
            return self._release(vehicle, now_ns)
        self._land_seen = True
        if not vehicle.on_ground:
            self._ground_since_ns = None
        elif self._ground_since_ns is None:
            self._ground_since_ns = now_ns
        elif (now_ns - self._ground_since_ns) / 1e9 > _DISARM_AFTER_S:
            return self._ask("disarm", now_ns)
        return []

    def _release(self, vehicle: Vehicle, now_ns: int) -> list[Order]:
        engaging = self.phase in ("streaming", "switching") and vehicle.mode in (self._mode_before, OFFBOARD)
        found = "armed" if engaging else f"mode {vehicle.mode}"
        self._go(
            "released",
            f"{found}, not by us: "
            + ("PX4 acts by its own failsafe" if vehicle.failsafe else "the pilot has the aircraft, or PX4's failsafe"),
            now_ns,
        )
        return []

    def _cancel(self, note: str, now_ns: int) -> list[Order]:
        armed = self.phase == "arming"
        self._go("quiet", note, now_ns)
        return ["disarm"] if armed else []

    def _ask(self, order: Order, now_ns: int) -> list[Order]:
        if self._asked_ns and (now_ns - self._asked_ns) / 1e9 < _REPEAT_S:
            return []
        self._asked_ns = now_ns
        return [order]

    def _go(self, phase: Phase, note: str, now_ns: int) -> None:
        self.phase, self.note, self._since_ns = phase, note, now_ns
        self._asked_ns = 0
        self._hold_since_ns = self._ground_since_ns = None

    def _elapsed_s(self, now_ns: int) -> float:
        return (now_ns - self._since_ns) / 1e9
