"""Looks at this machine and at the bus; judging is in ``findings``."""

from __future__ import annotations

import datetime as dt
import os
import shutil
import stat
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.health import Health
from schemas.topics import HEALTH, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.camera.calibrated import calibrated_on
from services.common.errors import InputError
from services.common.memlock import lockable_bytes
from services.common.version import running_version
from services.doctor.model import Facts, ServiceFact, VehicleFact, service_of
from services.doctor.told import told
from services.doctor.twins import Twins
from services.router.radio import absent
from services.security.identity import STATION

if TYPE_CHECKING:
    from services.common.config import TreedockConfig

USB_DEVICES = Path("/sys/bus/usb/devices")
_LISTEN_S = 2.2
"""Health comes once a second: of each process twice, so that two of one service are told apart from one started again."""


def gather(config: TreedockConfig) -> Facts:
    """Return what can be found out in about two seconds."""
    heard = _listen(config)
    folder = config.security.folder
    camera, mbit = _camera(config.camera.source)
    station = _is_station(config.security.identity)
    return Facts(
        router=None if heard.fault else config.router.endpoint,
        router_fault=heard.fault,
        services=_services(heard),
        vehicle=None if heard.vehicle is None else _vehicle(heard.vehicle),
        version=running_version(),
        units=_units(station=station),
        station=station,
        certificates=_certificates(folder) if folder else {},
        certificate_faults=_certificate_faults(folder) if folder else (),
        loose_keys=_loose_keys(folder) if folder else (),
        foreign_keys=_foreign_keys(folder) if folder else (),
        encrypted=folder is not None,
        radio_absent=absent(config.security.radio_interfaces) if folder and not station else (),
        reachable_from_outside=not config.router.local,
        clock_synchronised=_synchronised(),
        lockable_bytes=lockable_bytes(),
        shm_free_bytes=_free(Path("/dev/shm")),
        closed=_closed((folder, config.recorder.folder)),
        disk_reserve_bytes=config.recorder.reserve_mb * 1_000_000,
        disk_free_bytes=_free(_nearest(config.recorder.folder)) if config.recorder.mcap else None,
        recordings_cut=_cut(config.recorder.folder),
        camera=camera,
        camera_mbit=mbit,
        source=config.camera.source,
        camera_file=config.camera.camera_file,
        camera_fault=_camera_fault(config.camera.camera_file),
        real=config.autopilot.vehicle == "real",
        calibration_days=_age_days(config.camera.camera_file),
    )


def _vehicle(state: VehicleState) -> VehicleFact:
    return VehicleFact(state.connected, state.note, state.battery_share)


@dataclass
class _Heard:
    """What came over the bus in a while."""

    fault: str = ""
    health: dict[str, tuple[Health, float]] = field(default_factory=dict)
    """The latest of each service, and when it came (monotonic seconds)."""
    vehicle: VehicleState | None = None
    live: frozenset[str] = frozenset()
    unreadable: int = 0
    processes: Twins = field(default_factory=Twins)
    twice: set[str] = field(default_factory=set)

    def take_health(self, health: Health) -> None:
        if self.processes.hear(health, time.monotonic()):
            self.twice.add(health.service)
        self.health[health.service] = (health, time.monotonic())

    def take_vehicle(self, vehicle: VehicleState) -> None:
        self.vehicle = vehicle


def _listen(config: TreedockConfig) -> _Heard:
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_node

    heard, book = _Heard(), HealthBook()
    try:
        with opened_node(config, None, lambda: False, wait_s=0.0) as session:
            bus = Bus(session, config.uav, book)
            bus.subscribe(HEALTH, heard.take_health, "*")
            bus.subscribe(VEHICLE_STATE, heard.take_vehicle)
            deadline = time.monotonic() + _LISTEN_S
            while (left_s := deadline - time.monotonic()) > 0:
                bus.inbox.wait(left_s)
                while (taken := bus.inbox.take()) is not None:
                    taken[0].handler(taken[1])
            heard.live = frozenset(bus.live_services())
    except InputError as error:
        heard.fault = str(error)
    heard.unreadable = book.counters[f"decode_errors.{HEALTH.name}"]
    return heard


def _services(heard: _Heard) -> list[ServiceFact]:
    """Return a fact per live service: from its health, else that it is silent, or that its health could not be read."""
    found = [
        replace(_service(health, heard_s), twice=name in heard.twice)
        for name, (health, heard_s) in sorted(heard.health.items())
    ]
    state = "unreadable" if heard.unreadable else "silent"
    found += [ServiceFact(name, state, 0, "", 99.0, {}) for name in sorted(heard.live - set(heard.health))]
    return found


def _service(health: Health, heard_s: float) -> ServiceFact:
    age_s = time.monotonic() - heard_s
    fact = told(health, age_s=age_s, clock_offset_s=1e-9 * health.stamp_ns - (time.time() - age_s))
    process = _process_of(health)
    if process is None:
        return fact
    return replace(  # of this machine: its certificates and disk are looked at directly
        fact, locked_bytes=_locked_bytes(process), lockable_bytes=lockable_bytes(health.pid),
        certificate_days=None, disk_free_bytes=None,
    )  # fmt: skip


def _process_of(health: Health) -> Path | None:
    """Return a service's folder in /proc; None for one of another machine, whose number means somebody else here."""
    process = Path(f"/proc/{health.pid}")
    try:
        ours = health.service.encode() in (process / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return None
    return process if ours else None


def _locked_bytes(process: Path) -> int | None:
    """Return VmLck: what the limit says is not always what is in force."""
    try:
        lines = (process / "status").read_text().splitlines()
    except OSError:
        return None
    words = next((line.split() for line in lines if line.startswith("VmLck:")), None)
    return int(words[1]) * 1024 if words else None


def _units(*, station: bool) -> dict[str, str]:
    """Return the state of the units that are to run here: of those of the other kind of machine, or optional, what does run."""
    from services.cli.service_command import OPTIONAL

    said = _said("systemctl", "list-units", "--all", "--plain", "--no-legend", "treedock*.service")
    rows = [line.split() for line in said.splitlines()]
    states = {row[0]: row[2] for row in rows if len(row) > 2 and row[1] == "loaded"}

    def wanted(unit: str) -> bool:
        name = service_of(unit)
        return name not in OPTIONAL and (name == STATION) == station

    return {unit: state for unit, state in states.items() if state != "inactive" or wanted(unit)}


def _is_station(identity: str) -> bool:
    """Return whether this machine is a ground station alone, by its certificate's name or the target that it starts."""
    if identity:
        return identity.startswith(f"{STATION}.")
    said = _said("systemctl", "is-enabled", "treedock.target", "treedock-station.target")
    return said.split()[-1:] == ["enabled"] and not said.startswith("enabled")


def _said(*command: str) -> str:
    """Return what a tool of the system prints; nothing where it is not there, or hangs."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _certificates(folder: Path) -> dict[str, float]:
    from cryptography import x509

    now, found = dt.datetime.now(dt.UTC), {}
    for path in sorted(folder.glob("*.pem")):
        try:
            end = x509.load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc
        except (OSError, ValueError):  # told with the faults
            continue
        found[path.stem] = (end - now).total_seconds() / 86400.0
    return found


def _certificate_faults(folder: Path) -> list[str]:
    from services.security.machine import faults_in

    return [] if _hidden(folder) else faults_in(folder)


def _loose_keys(folder: Path) -> list[str]:
    others = stat.S_IRWXG | stat.S_IRWXO
    return [str(path) for path in sorted(folder.glob("*.key")) if path.stat().st_mode & others]


def _foreign_keys(folder: Path) -> list[str]:
    paths = sorted(folder.glob("*.key"))
    return [str(path) for path in paths if path.stat().st_uid != folder.stat().st_uid]


def _synchronised() -> bool | None:
    said = _said("timedatectl", "show", "-p", "NTPSynchronized", "--value")
    return {"yes": True, "no": False}.get(said.strip())


def _free(path: Path) -> int | None:
    try:
        return shutil.disk_usage(path).free
    except OSError:
        return None


def _nearest(folder: Path) -> Path:
    """Return the folder, or the first above it that this user can see."""
    nearest = folder.absolute()
    while not _seen(nearest):
        nearest = nearest.parent
    return nearest


def _seen(path: Path) -> bool:
    try:
        return path.exists()
    except PermissionError:
        return False


def _closed(folders: Iterable[Path | None]) -> list[str]:
    """Return the folders that are there and that this user may not look into."""
    return [str(path) for path in folders if path is not None and _hidden(path)]


def _hidden(path: Path) -> bool:
    try:
        return path.is_dir() and not os.access(path, os.R_OK | os.X_OK)
    except PermissionError:
        return True


def _cut(folder: Path) -> list[str]:
    from services.recorder.recover import cut_recordings

    try:
        return [] if _hidden(folder) or not folder.is_dir() else [str(path) for path in cut_recordings(folder)]
    except PermissionError:  # a recording that this user may not read
        return []


def _camera(source: str) -> tuple[str | None, float | None]:
    """Return what is there for a source, and the speed of its USB link (Mbit/s) where it has one."""
    place = source.partition(":")[2]
    if place:
        return (source if Path(place).exists() else None), None
    for device in sorted(USB_DEVICES.glob("*/product")):
        try:
            product, speed = device.read_text().strip(), (device.parent / "speed").read_text()
        except OSError:  # unplugged while we look
            continue
        if source in product.lower():
            return product, float(speed)
    return None, None


def _age_days(camera_file: str) -> float | None:
    day = calibrated_on(Path(camera_file)) if camera_file else None
    return None if day is None else float((dt.datetime.now(dt.UTC).date() - day).days)


def _camera_fault(camera_file: str) -> str:
    from services.camera.sources.camera_json import read_intrinsics

    try:
        if camera_file:
            read_intrinsics(Path(camera_file))
    except InputError as error:
        return str(error)
    return ""
