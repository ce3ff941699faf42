"""The autopilot's parameters: a typed table with PX4's encoding on the wire.

PX4 sends INT32 values bytewise: the four bytes of the integer sit in the float field of PARAM_VALUE and PARAM_SET
(MAVLink parameter protocol, "bytewise" encoding).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from services.common.errors import InputError

INT32, REAL32 = 6, 9
"""MAV_PARAM_TYPE of the two kinds that PX4 has."""

_INTEGERS: dict[str, int] = {
    "COM_ARM_WO_GPS": 1,
    "COM_OBL_RC_ACT": 0,
    "COM_RC_IN_MODE": 3,
    "COM_RC_OVERRIDE": 1,
    "COM_RCL_EXCEPT": 0,
    "COM_LOW_BAT_ACT": 0,
    "EKF2_BARO_CTRL": 1,
    "EKF2_EV_CTRL": 0,
    "EKF2_EV_NOISE_MD": 0,
    "EKF2_EV_QMIN": 0,
    "EKF2_GPS_CTRL": 7,
    "EKF2_HGT_REF": 1,
    "EKF2_MAG_TYPE": 0,
    "EKF2_NOAID_TOUT": 5_000_000,
    "MAV_SYS_ID": 1,
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 2,
    "SYS_AUTOSTART": 4001,
    "SYS_HAS_GPS": 1,
    "SYS_HAS_MAG": 1,
    "BAT1_N_CELLS": 4,
}

_REALS: dict[str, float] = {
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_OF_LOSS_T": 1.0,
    "COM_SPOOLUP_TIME": 1.0,
    "EKF2_DELAY_MAX": 200.0,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_EVA_NOISE": 0.1,
    "EKF2_EVP_GATE": 5.0,
    "EKF2_EVP_NOISE": 0.1,
    "EKF2_EVV_GATE": 3.0,
    "EKF2_EVV_NOISE": 0.1,
    "EKF2_HDG_GATE": 2.6,
    "EKF2_BARO_NOISE": 3.5,
    "MC_PITCH_P": 6.5,
    "MC_ROLL_P": 6.5,
    "MC_YAW_P": 2.8,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_YAWRATE_MAX": 200.0,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_LAND_SPEED": 0.7,
    "MPC_MAN_TILT_MAX": 35.0,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_THR_HOVER": 0.5,
    "MPC_VEL_MANUAL": 10.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_YAWRAUTO_MAX": 60.0,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "RTL_RETURN_ALT": 60.0,
    "BAT_CRIT_THR": 0.07,
    "BAT_LOW_THR": 0.15,
}

VISION_SET: dict[str, float] = {
    "EKF2_EV_CTRL": 11,
    "EKF2_HGT_REF": 3,
    "EKF2_GPS_CTRL": 0,
    "SYS_HAS_GPS": 0,
    "EKF2_MAG_TYPE": 5,
    "SYS_HAS_MAG": 0,
    "COM_RC_IN_MODE": 4,
    "COM_OBL_RC_ACT": 4,
    "EKF2_EVP_NOISE": 0.02,
    "EKF2_EVA_NOISE": 0.05,
    "EKF2_NOAID_TOUT": 1_000_000,
}
"""What design.md section 7 sets for flight on vision alone, in simulation."""

_RANGES: dict[str, tuple[float, float]] = {
    "EKF2_EVA_NOISE": (1e-4, 10.0),
    "EKF2_EVP_NOISE": (1e-4, 100.0),
    "EKF2_EVV_NOISE": (1e-4, 100.0),
    "MPC_THR_HOVER": (0.1, 0.8),
    "MPC_TILTMAX_AIR": (5.0, 80.0),
    "MPC_XY_P": (0.05, 5.0),
    "MPC_XY_VEL_MAX": (0.1, 50.0),
    "MPC_Z_P": (0.05, 5.0),
}
"""Where arithmetic would break outside; PX4 leaves ranges to the ground station."""

NAMES: tuple[str, ...] = tuple(sorted([*_INTEGERS, *_REALS]))


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as it stands."""

    name: str
    index: int
    type: int
    value: float

    @property
    def wire_value(self) -> float:
        """The float32 field that carries the value; an INT32's bytes reinterpreted."""
        if self.type == REAL32:
            return self.value
        return float(struct.unpack("<f", struct.pack("<i", int(self.value)))[0])


def integer_from_wire(field: float) -> int:
    """Return the INT32 whose bytes the float32 ``field`` carries."""
    return int(struct.unpack("<i", struct.pack("<f", field))[0])


def _in_range(name: str, value: float) -> bool:
    low, high = _RANGES.get(name, (-math.inf, math.inf))
    return math.isfinite(value) and low <= value <= high


class Parameters:
    """The parameter table; unknown names and wrong types are refused, as PX4 does, without a word."""

    def __init__(self, overrides: Mapping[str, float] | None = None) -> None:
        self._values: dict[str, float] = {**_INTEGERS, **_REALS, **VISION_SET}
        for name, value in (overrides or {}).items():
            if name not in self._values:
                raise InputError(f"simulator parameters: '{name}' is unknown; known are {', '.join(NAMES)}")
            if not _in_range(name, value):
                raise InputError(f"simulator parameters: {name} = {value:g} is outside {_RANGES.get(name)}")
            self._values[name] = value

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __len__(self) -> int:
        return len(NAMES)

    def integer(self, name: str) -> int:
        """Return an INT32 parameter."""
        return int(self._values[name])

    def get(self, name: str) -> Parameter | None:
        """Return the named parameter, or None."""
        if name not in self._values:
            return None
        kind = INT32 if name in _INTEGERS else REAL32
        return Parameter(name, NAMES.index(name), kind, self._values[name])

    def at(self, index: int) -> Parameter | None:
        """Return the parameter of an index, or None."""
        return self.get(NAMES[index]) if 0 <= index < len(NAMES) else None

    def set_from_wire(self, name: str, kind: int, field: float) -> Parameter | None:
        """Store what a PARAM_SET carries and return the parameter as it then stands; None refuses it.

        A type that is not the parameter's own is refused: the classic fault is an integer sent as a plain float.
        """
        known = self.get(name)
        if known is None or kind != known.type:
            return None
        if kind == REAL32 and not _in_range(name, field):
            return None
        self._values[name] = float(integer_from_wire(field)) if kind == INT32 else float(field)
        return self.get(name)

    def set(self, name: str, value: float) -> None:
        """Store a value directly (tests and the shell of the simulator)."""
        if name not in self._values or not _in_range(name, value):
            raise KeyError(f"{name} = {value:g}")
        self._values[name] = value
