"""The facts that a doctor collects and the findings made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Level = Literal["ok", "warn", "fail", "unknown"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report."""

    about: str
    level: Level
    text: str
    do: str = ""
    """What to do about it; empty when nothing is to be done."""


@dataclass(frozen=True, slots=True)
class ServiceFact:
    """A service as its latest health tells it."""

    name: str
    state: str
    pid: int
    note: str
    age_s: float
    rates_hz: Mapping[str, float]
    locked_bytes: int | None = None
    """VmLck of its process on this machine; None: another machine's, or unreadable."""
    lockable_bytes: int | None = None
    """What that process may lock, as really in force; -1: any amount."""
    clock_offset_s: float | None = None
    """Its stamps against this machine's clock; None: not told."""
    version: str = ""
    """Of the treedock that runs there; empty: it does not say."""
    clock_ahead_s: float | None = None
    """By how much its machine's clock is ahead of the router's, as it measured itself, and corrects; None: not told."""
    certificate_days: float | None = None
    """Until its certificate ends; None: not told (a plain bus), or looked at directly."""
    disk_free_bytes: int | None = None
    disk_reserve_bytes: int | None = None
    """Of the disk that it records on, and what it leaves free; None: not told, or looked at directly."""
    twice: bool = False
    """Two processes speak as it."""


@dataclass(frozen=True, slots=True)
class VehicleFact:
    """The aircraft as the autopilot's bridge tells it."""

    connected: bool
    note: str
    """What speaks against flying it: parameters that differ come first."""
    battery_share: float | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """Everything the doctor looked at; None stands for what could not be found out."""

    router: str | None = None
    """The address that answered, None when none did."""
    router_fault: str = ""
    """Why there is no session, in the words of the bus."""
    wanted_router: str = ""
    services: Sequence[ServiceFact] = ()
    vehicle: VehicleFact | None = None
    """None: the bridge said nothing."""
    version: str = ""
    """Of the treedock that asks."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit name to systemd's ActiveState, of those that are to run here; empty when none is installed."""
    station: bool = False
    """This machine is a ground station and no aircraft: it has no camera, passes no frames on and records nothing."""
    certificates: Mapping[str, float] = field(default_factory=dict)
    """Identity to days of validity left."""
    certificate_faults: Sequence[str] = ()
    """Why nodes that show these would be refused: missing, damaged, revoked, of another authority."""
    loose_keys: Sequence[str] = ()
    """Private keys that others can read."""
    foreign_keys: Sequence[str] = ()
    """Private keys that the owner of their folder, the services' user, may not read."""
    encrypted: bool = False
    radio_absent: Sequence[str] = ()
    """Radio interfaces of the configuration that this machine does not have."""
    reachable_from_outside: bool = False
    clock_synchronised: bool | None = None
    lockable_bytes: int | None = None
    """What this session may lock; -1: any amount."""
    shm_free_bytes: int | None = None
    closed: Sequence[str] = ()
    """Folders that this user may not look into."""
    disk_free_bytes: int | None = None
    """Of the disk that is recorded on; None also where nothing is recorded (``recorder.mcap``)."""
    disk_reserve_bytes: int = 500_000_000
    """What the recorder leaves free (``recorder.reserve_mb``)."""
    recordings_cut: Sequence[str] = ()
    camera: str | None = None
    """What the configured source found, None when nothing."""
    camera_mbit: float | None = None
    """Speed of its USB link."""
    source: str = "sim"
    camera_file: str = ""
    """The calibration in use; empty: the sensor's own, from the factory."""
    camera_fault: str = ""
    """Why that file cannot be used."""
    calibration_days: float | None = None
    """Its age; None: it does not say."""
    real: bool = False
    """The configuration says that a real aircraft is flown."""


def service_of(unit: str) -> str:
    """Return the service that a unit runs: ``slam`` of ``treedock-slam.service``."""
    return unit.removeprefix("treedock-").removesuffix(".service")
