"""PX4's parameters that a flight without GPS rests on, and what differs on the vehicle. Pure.

The values are design.md section 7's, measured on PX4 v1.16. A real aircraft must obey its sticks; a simulated one has
none. INT32 values travel bytewise in PARAM_SET and PARAM_VALUE: the float's bits are the integer's.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pymavlink.dialects.v20 import common as mav

from services.navigator.autopilot.px4 import AUTOPILOT_COMPONENT

VehicleKind = Literal["simulation", "real"]
_RELATIVE_TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True)
class Parameter:
    """What one parameter has to be, and why. ``integer``: INT32 on the wire."""

    name: str
    value: float
    why: str
    integer: bool = True
    only: VehicleKind | None = None
    accepted: tuple[float, ...] = ()
    """Other values that do as well."""
    must: bool = True
    """Preflight refuses otherwise; else it only tells."""


TABLE: tuple[Parameter, ...] = (
    Parameter("EKF2_EV_CTRL", 11, "fuse vision position, height and yaw", accepted=(15,)),
    Parameter("EKF2_HGT_REF", 3, "height from vision"),
    Parameter("EKF2_GPS_CTRL", 0, "no GPS"),
    Parameter("SYS_HAS_GPS", 0, "no GPS"),
    Parameter("EKF2_MAG_TYPE", 5, "heading from vision, no compass"),
    Parameter("SYS_HAS_MAG", 0, "no compass"),
    Parameter("EKF2_EVP_NOISE", 0.02, "least noise of the vision position, m", integer=False, must=False),
    Parameter("EKF2_EVA_NOISE", 0.05, "least noise of the vision angle, rad", integer=False, must=False),
    Parameter("EKF2_NOAID_TOUT", 1_000_000, "react within 1 s when vision stops, not after 5 s of drift"),
    Parameter("COM_ARM_WO_GPS", 1, "arm without GPS", accepted=(2,)),
    Parameter("NAV_DLL_ACT", 0, "no ground station link on this port is no fault"),
    Parameter("COM_OBL_RC_ACT", 4, "land when setpoints stop"),
    Parameter("COM_RC_IN_MODE", 4, "no sticks in simulation", only="simulation"),
    Parameter("COM_RC_IN_MODE", 0, "the sticks of a real aircraft must win", only="real"),
    Parameter("COM_RC_OVERRIDE", 3, "moving the sticks takes over, in offboard too", only="real"),
)


@dataclass(frozen=True, slots=True)
class Difference:
    """One parameter that is not as it has to be; ``found`` is None when the vehicle did not answer."""

    parameter: Parameter
    found: float | None

    @property
    def words(self) -> str:
        """Say it in one line."""
        found = "no answer" if self.found is None else f"{self.found:g}"
        return f"{self.parameter.name} is {found}, expected {self.parameter.value:g}: {self.parameter.why}"


def wanted(kind: VehicleKind) -> tuple[Parameter, ...]:
    """Return the parameters that hold for a kind of vehicle."""
    return tuple(p for p in TABLE if p.only in (None, kind))


def differences(found: Mapping[str, float], kind: VehicleKind) -> list[Difference]:
    """Return what differs, in the table's order. ``found`` holds the vehicle's values by name."""
    out = []
    for p in wanted(kind):
        value = found.get(p.name)
        tolerance = 0.0 if p.integer else _RELATIVE_TOLERANCE
        fits = value is not None and any(
            math.isclose(value, good, rel_tol=tolerance) for good in (p.value, *p.accepted)
        )
        if not fits:
            out.append(Difference(p, value))
    return out


def refusals(found: Mapping[str, float], kind: VehicleKind) -> list[str]:
    """Return the differences with which preflight refuses to fly, in words."""
    return [d.words for d in differences(found, kind) if d.parameter.must]


def table(found: Mapping[str, float], kind: VehicleKind) -> str:
    """Return all parameters as a Markdown table with what differs marked."""
    wrong = {d.parameter.name: d for d in differences(found, kind)}
    lines = ["| parameter | expected | found | | why |", "|---|---|---|---|---|"]
    for p in wanted(kind):
        value = found.get(p.name)
        shown = "no answer" if value is None else f"{value:g}"
        mark = ("REFUSED" if p.must else "differs") if p.name in wrong else "ok"
        expected = " or ".join(f"{v:g}" for v in (p.value, *p.accepted))
        lines.append(f"| {p.name} | {expected} | {shown} | {mark} | {p.why} |")
    return "\n".join(lines)


def read_value(value: float, kind: int) -> float:
    """Return the number in a PARAM_VALUE: bytewise for integers."""
    if kind in (mav.MAV_PARAM_TYPE_INT32, mav.MAV_PARAM_TYPE_INT16, mav.MAV_PARAM_TYPE_INT8):
        return float(struct.unpack("<i", struct.pack("<f", value))[0])
    if kind in (mav.MAV_PARAM_TYPE_UINT32, mav.MAV_PARAM_TYPE_UINT16, mav.MAV_PARAM_TYPE_UINT8):
        return float(struct.unpack("<I", struct.pack("<f", value))[0])
    return float(value)


def request(p: Parameter, system: int) -> mav.MAVLink_param_request_read_message:
    """Return the question for one parameter."""
    return mav.MAVLink_param_request_read_message(system, AUTOPILOT_COMPONENT, p.name.encode(), -1)


def setting(p: Parameter, system: int) -> mav.MAVLink_param_set_message:
    """Return the order to set one parameter."""
    if not p.integer:
        kind, value = mav.MAV_PARAM_TYPE_REAL32, p.value
    else:
        kind = mav.MAV_PARAM_TYPE_INT32
        value = struct.unpack("<f", struct.pack("<i", int(p.value)))[0]
    return mav.MAVLink_param_set_message(system, AUTOPILOT_COMPONENT, p.name.encode(), value, kind)


class ParameterReader:
    """Asks for all parameters of a kind of vehicle, a few at a time, until each has answered or was asked often.

    With ``change`` it then sets those that differ and reads them back. Who did not answer is asked again now and then:
    an autopilot that boots is slow.
    """

    def __init__(self, kind: VehicleKind, *, change: bool = False) -> None:
        self.kind = kind
        self.change = change
        self.found: dict[str, float] = {}
        self.changed: dict[str, float] = {}
        """What was set by us, and the value before."""
        self._asked: dict[str, int] = {}
        self._set: dict[str, int] = {}
        self._due_ns = 0
        self._again_ns = 0

    @property
    def complete(self) -> bool:
        """Whether every parameter has answered, or was asked for often enough."""
        return all(p.name in self.found or self._asked.get(p.name, 0) >= _TRIES for p in wanted(self.kind))

    def take(self, name: str, value: float, kind: int) -> None:
        """Take a PARAM_VALUE."""
        self.found[name.rstrip("\0")] = read_value(value, kind)

    def due(self, system: int, now_ns: int, *, may_set: bool = False) -> list[Any]:
        """Return the questions, and where it may set, the orders to send now."""
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + _ASK_EVERY_NS
        if not self.complete:
            open_ = [p for p in wanted(self.kind) if p.name not in self.found and self._asked.get(p.name, 0) < _TRIES]
            for p in open_[:_AT_ONCE]:
                self._asked[p.name] = self._asked.get(p.name, 0) + 1
            self._again_ns = now_ns + _AGAIN_NS
            return [request(p, system) for p in open_[:_AT_ONCE]]
        if now_ns >= self._again_ns:
            self._again_ns = now_ns + _AGAIN_NS
            return [request(p, system) for p in wanted(self.kind) if p.name not in self.found]
        return self._settings(system) if self.change and may_set else []

    def _settings(self, system: int) -> list[Any]:
        wrong = [d for d in differences(self.found, self.kind) if d.found is not None]
        due = [d for d in wrong if self._set.get(d.parameter.name, 0) < _TRIES][:_AT_ONCE]
        for d in due:
            self._set[d.parameter.name] = self._set.get(d.parameter.name, 0) + 1
            self.changed.setdefault(d.parameter.name, d.found if d.found is not None else 0.0)
        return [setting(d.parameter, system) for d in due]


_TRIES, _AT_ONCE, _ASK_EVERY_NS, _AGAIN_NS = 5, 6, 200_000_000, 10_000_000_000
