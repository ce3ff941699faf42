"""What the doctor found, judged from facts alone: arrays of facts in, findings out. Each finding says what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from schemas.topics import TOPICS

Level = Literal["ok", "warn", "fail", "unknown"]

EXPIRY_WARN_DAYS = 30
CALIBRATION_WARN_DAYS = 180
_GB = 1_000_000_000
DISK_WARN_BYTES, DISK_FAIL_BYTES = 5 * _GB, _GB // 2
SHM_WARN_BYTES = 256_000_000
_RATE_LOW = 0.7
_CLOCK_WARN_S = 0.05


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
    clock_offset_s: float | None = None
    """Its stamps against this machine's clock; None: not told."""


@dataclass(frozen=True, slots=True)
class Facts:
    """Everything the doctor looked at; None stands for what could not be found out."""

    router: str | None = None
    """The address that answered, None when none did."""
    wanted_router: str = ""
    services: Sequence[ServiceFact] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit name to systemd's ActiveState; empty when none is installed."""
    certificates: Mapping[str, float] = field(default_factory=dict)
    """Identity to days of validity left."""
    loose_keys: Sequence[str] = ()
    """Private keys that others can read."""
    encrypted: bool = False
    reachable_from_outside: bool = False
    clock_synchronised: bool | None = None
    locked_limit_bytes: int | None = None
    """RLIMIT_MEMLOCK of this session; -1: unlimited."""
    shm_free_bytes: int | None = None
    disk_free_bytes: int | None = None
    recordings_cut: Sequence[str] = ()
    camera: str | None = None
    """What the configured source found, None when nothing."""
    source: str = "sim"
    calibration_days: float | None = None


def judge(facts: Facts) -> list[Finding]:
    """Return the findings, in the order in which a person would go about them."""
    return [
        *_units(facts),
        *_bus(facts),
        *_security(facts),
        *_clock(facts),
        *_memory(facts),
        *_disk(facts),
        *_camera(facts),
        *_rates(facts),
    ]


def _units(f: Facts) -> list[Finding]:
    if not f.units:
        return [Finding("units", "unknown", "no treedock unit is installed on this machine", "sudo deploy/install")]
    bad = {name: state for name, state in f.units.items() if state in {"failed", "activating", "deactivating"}}
    if bad:
        words = ", ".join(f"{name} is {state}" for name, state in sorted(bad.items()))
        first = sorted(bad)[0]
        return [Finding("units", "fail", words, f"journalctl -u {first} -n 50; then systemctl restart {first}")]
    active = sum(state == "active" for state in f.units.values())
    if not active:
        return [Finding("units", "warn", "all units are stopped", "sudo systemctl start treedock.target")]
    return [Finding("units", "ok", f"{active} of {len(f.units)} active")]


def _bus(f: Facts) -> list[Finding]:
    if f.router is None:
        do = "systemctl status treedock-router, or `treedock run`; is router.host right?"
        return [Finding("router", "fail", f"nobody answers at {f.wanted_router}", do)]
    found = [Finding("router", "ok", f.router)]
    for service in f.services:
        if service.age_s > 5.0:
            do = f"systemctl restart treedock-{service.name}"
            found.append(Finding(service.name, "fail", f"silent for {service.age_s:.0f} s: hung or gone", do))
        elif service.state == "degraded":
            found.append(
                Finding(service.name, "warn", service.note or "degraded", "see the note; treedock topic echo health")
            )
        else:
            found.append(Finding(service.name, "ok", service.state))
    if not f.services:
        found.append(Finding("services", "warn", "no service is up", "sudo systemctl start treedock.target"))
    return found


def _security(f: Facts) -> list[Finding]:
    if not f.encrypted:
        if f.reachable_from_outside:
            do = "treedock certs init / issue / export, then security.folder and router.protocol = tls"
            return [
                Finding("encryption", "fail", "the bus is plain and listens to other machines: anybody can fly", do)
            ]
        return [Finding("encryption", "ok", "the bus is plain and stays on this machine")]
    found = []
    for identity, days in sorted(f.certificates.items()):
        do = f"treedock certs renew {identity}, then certs export"
        if days <= 0:
            found.append(Finding("certificate", "fail", f"{identity} expired {-days:.0f} days ago", do))
        elif days < EXPIRY_WARN_DAYS:
            found.append(Finding("certificate", "warn", f"{identity} expires in {days:.0f} days", do))
    found += [Finding("keys", "fail", f"{path} can be read by others", f"chmod 600 {path}") for path in f.loose_keys]
    return found or [Finding("certificates", "ok", f"{len(f.certificates)} valid")]


def _clock(f: Facts) -> list[Finding]:
    found = []
    if f.clock_synchronised is False:
        do = "install chrony; on the aircraft take the ground station's clock as server"
        found.append(Finding("clock", "warn", "this machine's clock is not synchronised", do))
    for service in f.services:
        offset = service.clock_offset_s
        if offset is not None and abs(offset) > _CLOCK_WARN_S:
            words = f"{service.name}'s machine is {1e3 * offset:+.0f} ms off this one"
            found.append(Finding("clock", "warn", words, "synchronise both machines with chrony"))
    return found or [Finding("clock", "unknown" if f.clock_synchronised is None else "ok", "synchronised" if f.clock_synchronised else "no word from timedatectl")]  # fmt: skip


def _memory(f: Facts) -> list[Finding]:
    found = []
    if f.shm_free_bytes is not None and f.shm_free_bytes < SHM_WARN_BYTES:
        text = f"/dev/shm has {f.shm_free_bytes // 1_000_000} MB left: camera frames will not fit"
        found.append(Finding("shared memory", "fail", text, "free it, or mount it larger (size= in /etc/fstab)"))
    camera = next((s for s in f.services if s.name == "camera"), None)
    cure = "LimitMEMLOCK=infinity in the unit; where that is not in force (containers), CAP_IPC_LOCK"
    if camera is not None and camera.locked_bytes == 0:
        words = "the camera's process holds no locked memory: shared memory is off and frames cost four times as much"
        found.append(Finding("shared memory", "warn", words, cure))
    elif camera is None and f.locked_limit_bytes is not None and 0 <= f.locked_limit_bytes < 64_000_000:
        words = f"this session may lock {f.locked_limit_bytes // 1000} KB: started from here, frames would be copied"
        found.append(Finding("shared memory", "warn", words, cure))
    return found or [Finding("shared memory", "ok", "in force" if camera and camera.locked_bytes else "available")]


def _disk(f: Facts) -> list[Finding]:
    found = []
    if f.disk_free_bytes is not None:
        gigabytes = f.disk_free_bytes / _GB
        do = "copy recordings away and delete them"
        if f.disk_free_bytes < DISK_FAIL_BYTES:
            found.append(Finding("disk", "fail", f"{gigabytes:.1f} GB left: nothing will be recorded", do))
        elif f.disk_free_bytes < DISK_WARN_BYTES:
            found.append(
                Finding("disk", "warn", f"{gigabytes:.1f} GB left: about {gigabytes / 13:.1f} h of recording", do)
            )
        else:
            found.append(Finding("disk", "ok", f"{gigabytes:.0f} GB left"))
    if f.recordings_cut:
        words = f"{len(f.recordings_cut)} recording(s) were cut short"
        found.append(Finding("recordings", "warn", words, "treedock recordings --recover"))
    return found


def _camera(f: Facts) -> list[Finding]:
    if f.source == "sim":
        return [Finding("camera", "ok", "simulated")]
    if f.camera is None:
        do = "lsusb; another cable and port; udevadm control --reload; is the user in groups video and plugdev?"
        return [Finding("camera", "fail", f"{f.source}: not found", do)]
    found = [Finding("camera", "ok", f.camera)]
    if f.calibration_days is not None and f.calibration_days > CALIBRATION_WARN_DAYS:
        words = f"calibrated {f.calibration_days:.0f} days ago"
        found.append(Finding("calibration", "warn", words, "treedock calibrate IMAGES..."))
    return found


def _rates(f: Facts) -> list[Finding]:
    """Compare what each producer says it sends with the table."""
    found = []
    for service in f.services:
        for topic in TOPICS:
            if topic.producer != service.name or not topic.rate_hz or topic.timeout_s is None:
                continue
            rate = service.rates_hz.get(topic.name)
            if rate is not None and rate < _RATE_LOW * topic.rate_hz:
                words = f"{rate:.1f} Hz, {topic.rate_hz:g} expected"
                found.append(
                    Finding(topic.name, "warn", words, f"is the machine overloaded? treedock topic hz {topic.name}")
                )
    return found
