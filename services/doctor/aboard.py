"""What the services and the aircraft say of themselves, judged: for the doctor, and for preflight. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from schemas.topics import TOPICS
from services.common.version import same_contract
from services.doctor.model import Finding, Level, ServiceFact, VehicleFact

SILENT_S = 5.0
RATE_LOW = 0.7
"""Share of a topic's rate in the table below which it is told."""
CLOCK_WARN_S, CLOCK_FAIL_S = 0.05, 0.5
EXPIRY_WARN_DAYS, EXPIRY_FAIL_DAYS = 30.0, 1.0 / 24.0
"""The latter is longer than a flight."""
_GB = 1_000_000_000
DISK_WARN_BYTES = 5 * _GB
_GB_AN_HOUR = 13.0
"""docs/operations.md, for a forest at 15 Hz."""
PARAMETERS = "parameters"
"""How the bridge's note begins while parameters speak against a flight."""
_RESTART = "systemctl restart treedock-{}; journalctl -u treedock-{} -n 50 tells why"


def aboard(services: Sequence[ServiceFact], vehicle: VehicleFact | None, version: str) -> list[Finding]:
    """Return the findings on services, versions, clocks, rates and the autopilot.

    Args:
        services: as their latest health tells them.
        vehicle: None when the bridge said nothing.
        version: of the treedock that asks.
    """
    return [
        *(state_of(service) for service in services),
        *versions(services, version),
        *clocks(services),
        *certificates(services),
        *disks(services),
        *rates(services),
        *autopilot(services, vehicle),
    ]


def state_of(service: ServiceFact) -> Finding:
    """Return how a service is."""
    name = service.name
    if service.state == "unreadable":
        words = "is live, but its health cannot be read: another version of treedock?"
        return Finding(name, "fail", words, "install the same version on both machines: sudo deploy/install")
    if service.twice:
        words = "runs twice: two processes speak as it, and both would fly"
        return Finding(
            name, "fail", words, f"stop the one that should not run: systemctl disable --now treedock-{name}"
        )
    if service.age_s > SILENT_S:
        words = "is live and says nothing: hung" if service.state == "silent" else f"silent for {service.age_s:.0f} s"
        return Finding(name, "fail", words, _RESTART.format(name, name))
    if service.state == "degraded":
        return Finding(name, "warn", service.note or "degraded", f"treedock topic echo health/{name} shows it live")
    return Finding(name, "ok", service.state + (f": {service.note}" if service.note else ""))


def versions(services: Sequence[ServiceFact], ours: str) -> list[Finding]:
    """Compare what runs at the other ends with what asks."""
    do = "install the same version on both machines (sudo deploy/install) and restart the services"
    by_version: dict[str, list[str]] = {}
    for service in services:
        if service.version:
            by_version.setdefault(service.version, []).append(service.name)
    found = []
    for version, names in sorted(by_version.items()):
        words = f"{', '.join(names)}: treedock {version}, this is {ours}"
        if not same_contract(version, ours):
            found.append(Finding("versions", "fail", f"{words}; they may refuse each other's messages", do))
        elif version != ours:
            found.append(Finding("versions", "warn", words, do))
    if found or not by_version:
        return found
    return [Finding("versions", "ok", f"treedock {ours} everywhere")]


def clocks(services: Sequence[ServiceFact]) -> list[Finding]:
    """Return whose clock is not this machine's."""
    found = []
    for service in services:
        ahead = service.clock_ahead_s
        if ahead is not None and abs(ahead) > CLOCK_WARN_S:
            words = (
                f"{service.name}'s machine is {1e3 * ahead:+.0f} ms off the router's: its stamps are corrected for it"
            )
            found.append(Finding("clock", "warn", words, "synchronise both machines with chrony"))
        offset = service.clock_offset_s
        if offset is None or abs(offset) <= CLOCK_WARN_S:
            continue
        words = f"{service.name}'s machine is {1e3 * offset:+.0f} ms off this one"
        level: Level = "fail" if abs(offset) > CLOCK_FAIL_S else "warn"
        found.append(Finding("clock", level, words, "synchronise both machines with chrony"))
    return found


def certificates(services: Sequence[ServiceFact]) -> Iterator[Finding]:
    """Return whose certificate ends soon."""
    for service in services:
        if service.certificate_days is not None:
            yield from certificate(f"{service.name}'s", service.certificate_days)


def certificate(whose: str, days: float) -> Iterator[Finding]:
    """Judge the days until a certificate ends: a link whose certificate ends is closed, whatever flies by it."""
    do = "treedock certs renew (the aircraft's .all, or the station's), then certs export and import"
    if days <= 0.0:
        yield Finding("certificate", "fail", f"{whose} expired {-days:.0f} days ago", do)
    elif days < EXPIRY_FAIL_DAYS:
        yield Finding("certificate", "fail", f"{whose} expires in {1440.0 * days:.0f} minutes", do)
    elif days < EXPIRY_WARN_DAYS:
        yield Finding("certificate", "warn", f"{whose} expires in {days:.0f} days", do)


def disks(services: Sequence[ServiceFact]) -> Iterator[Finding]:
    """Return who records on a disk that is full."""
    for service in services:
        if service.disk_free_bytes is not None:
            yield disk(f"{service.name}'s disk", service.disk_free_bytes, service.disk_reserve_bytes or 0)


def disk(about: str, free_bytes: int, reserve_bytes: int) -> Finding:
    """Judge the room on a disk that is recorded on."""
    gigabytes, do = (
        free_bytes / _GB,
        "copy recordings away and delete them, or recorder.mcap = false: nothing is recorded",
    )
    if free_bytes < reserve_bytes:
        words = f"{gigabytes:.1f} GB left, {reserve_bytes / _GB:.1f} are left free: frames will not be recorded"
        return Finding(about, "fail", words, do)
    if free_bytes < DISK_WARN_BYTES:
        return Finding(
            about, "warn", f"{gigabytes:.1f} GB left: about {gigabytes / _GB_AN_HOUR:.1f} h of recording", do
        )
    return Finding(about, "ok", f"{gigabytes:.0f} GB left")


def rates(services: Sequence[ServiceFact]) -> Iterator[Finding]:
    """Compare what each producer says it sends with the topics table."""
    for service in services:
        for topic in TOPICS:
            if topic.producer != service.name or not topic.rate_hz or topic.timeout_s is None:
                continue
            rate = service.rates_hz.get(topic.name)
            if rate is not None and rate < RATE_LOW * topic.rate_hz:
                words = f"{rate:.1f} Hz, {topic.rate_hz:g} expected"
                do = f"is the machine overloaded (top)? does its own input come? treedock topic hz {topic.name}"
                yield Finding(topic.name, "warn", words, do)


def autopilot(services: Sequence[ServiceFact], vehicle: VehicleFact | None) -> list[Finding]:
    """Return whether the autopilot is there and set as a flight without GPS needs it."""
    if not any(service.name == "autopilot" for service in services):
        return []
    about = "PX4"
    if vehicle is None or not vehicle.connected:
        do = "is it powered? is autopilot.connection right (serial:/dev/treedock-px4:921600)? ls -l /dev/treedock-px4"
        return [Finding(about, "warn", "no word from the autopilot", do)]
    if vehicle.note.startswith(f"{PARAMETERS}:"):
        do = "set them in QGroundControl, or autopilot.set_parameters = true; then start the autopilot again"
        return [Finding(about, "fail", vehicle.note, do)]
    if vehicle.note:
        return [Finding(about, "warn", vehicle.note, "treedock topic echo vehicle/state shows it live")]
    battery = "" if vehicle.battery_share is None else f", battery at {100.0 * vehicle.battery_share:.0f} %"
    return [Finding(about, "ok", f"connected, its parameters are as they have to be{battery}")]


def against_flight(services: Sequence[ServiceFact], vehicle: VehicleFact | None, version: str) -> list[str]:
    """Return, for preflight, what the doctor would call a failure."""
    return [f"{f.about}: {f.text}" for f in aboard(services, vehicle, version) if f.level == "fail"]
