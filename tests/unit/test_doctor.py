"""The doctor: each trouble gives its finding with what to do, a sound machine none."""

from __future__ import annotations

import datetime as dt
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from schemas.health import Health
from schemas.topics import HEALTH, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.common.clock import WallClock
from services.common.config import TreedockConfig
from services.common.context import Context, HealthBook
from services.common.memory import Hub
from services.common.version import running_version
from services.doctor.aboard import against_flight
from services.doctor.facts import gather
from services.doctor.findings import judge
from services.doctor.model import Facts, ServiceFact, VehicleFact
from services.doctor.told import told
from services.doctor.twins import Twins
from services.navigator.config import NavigatorConfig
from services.navigator.preflight import missing
from services.navigator.service import Navigator
from services.recorder.space import tell_space
from services.security.authority import Authority
from services.security.config import SecurityConfig
from services.security.expiry import Expiry
from services.security.identity import Identity
from tests.examples import all_messages

CAMERA = ServiceFact(
    "camera",
    "ready",
    10,
    "",
    0.2,
    {"camera/rgbd": 15.0},
    locked_bytes=50_000_000,
    lockable_bytes=-1,
    clock_offset_s=0.001,
    version="0.1.0+same",
)
SLAM = ServiceFact("slam", "ready", 11, "", 0.2, {"slam/pose": 15.0}, clock_offset_s=0.001)
SOUND = Facts(
    router="tcp/127.0.0.1:7447", wanted_router="tcp/127.0.0.1:7447", services=(CAMERA, SLAM),
    units={"treedock-camera.service": "active", "treedock-slam.service": "active"}, clock_synchronised=True, lockable_bytes=-1, shm_free_bytes=10**10,
    version="0.1.0+same", disk_free_bytes=10**11, camera="realsense: 4 video devices", source="realsense", calibration_days=20.0,
)  # fmt: skip
PX4 = ServiceFact("autopilot", "ready", 12, "", 0.2, {"vehicle/state": 20.0})
FLYING = replace(
    SOUND, services=(CAMERA, SLAM, PX4), vehicle=VehicleFact(connected=True, note="", battery_share=0.8),
    units={**SOUND.units, "treedock-autopilot.service": "active"},
)  # fmt: skip
STOPPED = {"treedock-slam.service": "inactive"}
WRONG = "parameters: EKF2_EV_CTRL is 0, expected 11: fuse vision position, height and yaw"
ENCRYPTED = replace(SOUND, encrypted=True, certificates={"uav1.slam": 200.0}, reachable_from_outside=True)


def test_a_sound_machine_has_no_trouble() -> None:
    for facts in (SOUND, ENCRYPTED, FLYING):
        assert {finding.level for finding in judge(facts)} == {"ok"}


@pytest.mark.parametrize(
    ("facts", "about", "level", "word"),
    [
        (replace(SOUND, router=None, services=()), "router", "fail", "7447"),
        (replace(SOUND, services=(), units=STOPPED), "services", "warn", "no service"),
        (replace(ENCRYPTED, services=(), units=STOPPED), "services", "warn", "or this certificate is revoked"),
        (replace(SOUND, services=(CAMERA,)), "services", "fail", "slam: running, and nothing of it is heard"),
        (replace(SOUND, services=()), "services", "fail", "camera, slam: running"),
        (replace(FLYING, units={**FLYING.units, **STOPPED}), "units", "warn", "treedock-slam.service is stopped"),
        (replace(SOUND, units={"treedock-slam.service": "failed"}), "units", "fail", "treedock-slam"),
        (replace(SOUND, units=STOPPED), "units", "warn", "all units are stopped"),
        (replace(SOUND, units={}), "units", "unknown", "no treedock unit"),
        (replace(SOUND, services=(replace(SLAM, age_s=9.0),)), "slam", "fail", "silent"),
        (replace(SOUND, services=(replace(SLAM, state="degraded", note="lost"),)), "slam", "warn", "lost"),
        (replace(SOUND, services=(replace(SLAM, twice=True),)), "slam", "fail", "runs twice"),
        (replace(SOUND, services=(replace(SLAM, rates_hz={"slam/pose": 4.0}),)), "slam/pose", "warn", "4.0 Hz, 15"),
        (replace(SOUND, services=(replace(CAMERA, locked_bytes=24_000),)), "shared memory", "warn", "are copied"),
        (replace(SOUND, services=(replace(CAMERA, lockable_bytes=8_000_000),)), "shared memory", "warn", "8000 KB"),
        (replace(SOUND, services=(replace(SLAM, clock_offset_s=0.2),)), "clock", "warn", "+200 ms"),
        (replace(SOUND, clock_synchronised=False), "clock", "warn", "not synchronised"),
        (replace(SOUND, shm_free_bytes=10**6), "shared memory", "fail", "/dev/shm"),
        (replace(SOUND, services=(), lockable_bytes=8_000_000), "shared memory", "warn", "8000 KB"),
        (replace(SOUND, closed=("/var/lib/treedock/recordings",)), "rights", "warn", "may not look"),
        (replace(SOUND, disk_free_bytes=10**8), "disk", "fail", "0.1 GB"),
        (replace(SOUND, disk_free_bytes=2 * 10**9), "disk", "warn", "2.0 GB"),
        (replace(SOUND, disk_free_bytes=10**9, disk_reserve_bytes=2 * 10**9), "disk", "fail", "2.0 are left free"),
        (
            replace(SOUND, services=(replace(SLAM, disk_free_bytes=10**8, disk_reserve_bytes=10**9),)),
            "slam's disk",
            "fail",
            "0.1 GB",
        ),
        (replace(SOUND, services=(replace(SLAM, disk_free_bytes=10**9),)), "slam's disk", "warn", "0.1 h"),
        (
            replace(SOUND, services=(replace(SLAM, certificate_days=0.01),)),
            "certificate",
            "fail",
            "slam's expires in 14 minutes",
        ),
        (
            replace(SOUND, services=(replace(SLAM, certificate_days=3.0),)),
            "certificate",
            "warn",
            "slam's expires in 3 days",
        ),
        (replace(SOUND, recordings_cut=("a.mcap",)), "recordings", "warn", "1 recording"),
        (replace(SOUND, camera=None), "camera", "fail", "not found"),
        (replace(SOUND, camera_mbit=480.0), "camera", "warn", "480 Mbit/s"),
        (replace(SOUND, camera_file="c.json", calibration_days=400.0), "calibration", "warn", "400 days"),
        (replace(SOUND, camera=None, camera_file="c.json", calibration_days=400.0), "calibration", "warn", "400 days"),
        (replace(SOUND, camera_file="c.json", calibration_days=-9.0), "calibration", "warn", "9 days in the future"),
        (replace(SOUND, camera_file="c.json", camera_fault="c.json: fx missing"), "calibration", "fail", "fx missing"),
        (replace(SOUND, source="sim", real=True), "camera", "fail", "simulated, for a real aircraft"),
        (replace(SOUND, camera_file="c.json", calibration_days=None), "calibration", "warn", "does not say"),
        (replace(SOUND, services=(replace(SLAM, state="unreadable", age_s=99.0),)), "slam", "fail", "another version"),
        (replace(SOUND, services=(replace(SLAM, state="silent", age_s=99.0),)), "slam", "fail", "hung"),
        (replace(SOUND, services=(replace(SLAM, version="0.1.0+other"),)), "versions", "fail", "0.1.0+other"),
        (replace(SOUND, services=(replace(SLAM, version="0.2.0+same"),)), "versions", "warn", "0.2.0+same"),
        (replace(SOUND, services=(replace(SLAM, clock_offset_s=-1.2),)), "clock", "fail", "-1200 ms"),
        (replace(SOUND, services=(PX4,), vehicle=None), "PX4", "warn", "no word"),
        (replace(SOUND, services=(PX4,), vehicle=VehicleFact(connected=False, note="")), "PX4", "warn", "no word"),
        (replace(FLYING, vehicle=VehicleFact(connected=True, note=WRONG)), "PX4", "fail", "EKF2_EV_CTRL is 0"),
        (
            replace(FLYING, vehicle=VehicleFact(connected=True, note="parameters are still being read")),
            "PX4",
            "warn",
            "being read",
        ),
        (replace(SOUND, router=None, router_fault="refused: no certificate"), "router", "fail", "no certificate"),
        (replace(SOUND, reachable_from_outside=True), "encryption", "fail", "anybody"),
        (replace(ENCRYPTED, certificates={"uav1.slam": 12.0}), "certificate", "warn", "12 days"),
        (replace(ENCRYPTED, certificates={"uav1.slam": -3.0}), "certificate", "fail", "3 days ago"),
        (
            replace(ENCRYPTED, certificates={"ca": 12.0}),
            "certificate",
            "warn",
            "the authority's own expires in 12 days",
        ),
        (replace(ENCRYPTED, certificate_faults=("a.pem: damaged",)), "certificate", "fail", "a.pem: damaged"),
        (replace(ENCRYPTED, certificates={}), "certificates", "unknown", "could not be looked at"),
        (replace(ENCRYPTED, radio_absent=("wlan7",)), "radio", "warn", "wlan7: no network interface here"),
        (replace(ENCRYPTED, loose_keys=("/etc/x.key",)), "keys", "fail", "/etc/x.key"),
        (replace(ENCRYPTED, foreign_keys=("/etc/x.key",)), "keys", "fail", "services' user"),
    ],
)
def test_each_trouble_has_its_finding_and_what_to_do(facts: Facts, about: str, level: str, word: str) -> None:
    found = [finding for finding in judge(facts) if finding.about == about and finding.level == level]
    assert len(found) == 1
    assert word in found[0].text
    assert found[0].do


STATION = replace(
    ENCRYPTED, station=True, services=(SLAM, replace(SLAM, name="station", rates_hz={})), camera=None, source="realsense", disk_free_bytes=10**7, shm_free_bytes=10**7,
    units={"treedock-station.service": "active"},
)  # fmt: skip


def test_a_station_is_not_asked_for_a_camera_or_a_disk_to_record_on() -> None:
    assert {finding.level for finding in judge(STATION)} == {"ok"}
    about = {finding.about for finding in judge(STATION)}
    assert about.isdisjoint({"camera", "calibration", "disk", "recordings", "shared memory"})
    assert {f.about for f in judge(replace(STATION, station=False)) if f.level == "fail"} >= {"camera", "disk"}


@pytest.mark.parametrize(
    ("facts", "about", "do"),
    [
        (replace(STATION, units={"treedock-station.service": "inactive"}), "units", "start treedock-station.target"),
        (
            replace(STATION, services=(), units={"treedock-station.service": "inactive"}),
            "services",
            "start treedock-station.target",
        ),
        (replace(STATION, router=None, router_fault="nobody answers"), "router", "router.host"),
    ],
)
def test_a_station_is_told_what_to_do_on_a_station(facts: Facts, about: str, do: str) -> None:
    (finding,) = [f for f in judge(facts) if f.about == about]
    assert do in finding.do
    assert "treedock.target" not in finding.do


@pytest.mark.parametrize(
    ("identity", "enabled", "station"),
    [
        ("", ("disabled", "enabled"), True),
        ("", ("enabled", "enabled"), False),
        ("", ("enabled", "disabled"), False),
        ("", (), False),
        ("station.alice", (), True),
        ("uav1.all", ("disabled", "enabled"), False),
    ],
)
def test_a_machine_is_a_station_by_its_certificate_or_by_what_it_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, identity: str, enabled: tuple[str, ...], station: bool
) -> None:
    systemctl = tmp_path / "systemctl"
    words = "".join(f"echo {word}\n" for word in enabled)
    systemctl.write_text(f'#!/bin/sh\n[ "$1" = is-enabled ] || exit 0\n{words}exit 1\n')
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    config = TreedockConfig(security=SecurityConfig(identity=identity))
    assert gather(config.model_copy(update={"router": config.router.model_copy(update={"port": 1})})).station is station


def test_preflight_hears_of_failures_and_only_of_those() -> None:
    hot = replace(SLAM, state="degraded", note="lost", version="0.1.0+other")
    told = against_flight((CAMERA, hot), VehicleFact(connected=True, note=WRONG), "0.1.0+same")
    assert len(told) == 1
    assert "0.1.0+other" in told[0]
    assert against_flight((PX4,), VehicleFact(connected=True, note=WRONG), "0.1.0+same") == [f"PX4: {WRONG}"]


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


def health(service: str, **values: Any) -> Health:
    given = {
        "stamp_ns": 1,
        "seq": 0,
        "state": "ready",
        "pid": 7,
        "uptime_s": 1.0,
        "counters": {},
        "rates_hz": {},
        "work_ms": {},
    }
    return Health.model_validate({"service": service, **given, "version": running_version(), **values})


def test_what_a_service_tells_of_its_machine_arrives(tmp_path: Path) -> None:
    book, now = HealthBook(), dt.datetime.now(dt.UTC)
    tell_space(book, tmp_path, 400)
    Authority.create(tmp_path, now).issue(Identity.parse("uav1.recorder"), now, days=10)
    Expiry(SecurityConfig(folder=tmp_path), "uav1", "recorder").tell(book, now)
    fact = told(health("recorder", counters=dict(book.counters)), clock_offset_s=0.2)
    assert fact.disk_free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, abs=2e8)
    assert fact.disk_reserve_bytes == 400_000_000
    assert fact.certificate_days == pytest.approx(10.0, abs=0.001)
    assert fact.clock_offset_s == 0.2
    plain = HealthBook()
    Expiry(SecurityConfig(), "uav1", "recorder").tell(plain, now)
    assert told(health("camera", counters=dict(plain.counters))).certificate_days is None
    tell_space(plain, tmp_path / "gone", 1)
    assert told(health("recorder", counters=dict(plain.counters))).disk_free_bytes == 0


@pytest.mark.parametrize(
    ("service", "counters", "word"),
    [
        ("recorder", {"disk_free_mb": 100, "disk_reserve_mb": 500}, "recorder's disk: 0.1 GB left"),
        ("router", {"certificate_minutes_left": 20}, "certificate: router's expires in 20 minutes"),
        ("station", {"certificate_minutes_left": 0}, "certificate: station's expired"),
    ],
)
def test_preflight_hears_what_the_doctor_would_find(service: str, counters: dict[str, int], word: str) -> None:
    hub = Hub(TreedockConfig())
    navigator = Navigator(cast("Context", hub.context("navigator")), NavigatorConfig(live_guard=False))
    navigator.register(20.0)
    state = VehicleState(**{**example(VehicleState).model_dump(), "connected": True, "note": ""})

    def told_to_preflight(**values: Any) -> list[str]:
        hub.context(service).publish(HEALTH, health(service, **values), service)
        hub.context("autopilot").publish(VEHICLE_STATE, state)
        hub.run()
        navigator.step()
        return missing(navigator.mission.board, navigator.mission.config)

    assert any(word in fault for fault in told_to_preflight(counters=counters))
    assert not any(word in fault for fault in told_to_preflight(counters={}))
    told_to_preflight(counters=counters)
    assert not any(word in fault for fault in told_to_preflight(counters=counters, state="stopping")), (
        "it was ended on purpose"
    )


def heard_as_twins(*words: tuple[float, int, float], service: str = "slam") -> list[bool]:
    """Each word: when it comes, of which process, how old that is."""
    twins = Twins()
    return [twins.hear(health(service, pid=pid, uptime_s=uptime_s), now_s) for now_s, pid, uptime_s in words]


def test_two_processes_of_one_service_are_told_from_one_started_again() -> None:
    two = [(0.0, 7, 50.0), (0.4, 9, 3.0), (1.0, 7, 51.0), (1.4, 9, 4.0)]
    assert heard_as_twins(*two) == [False, False, True, True]
    assert heard_as_twins(*two, service="station") == [False] * 4, "of those there may be several"
    assert heard_as_twins(*two, (4.0, 7, 54.0), (5.0, 7, 55.0))[-1:] == [False], "the other was stopped"
    same_number = [(0.0, 7, 50.0), (0.4, 7, 3.0), (1.0, 7, 51.0), (1.4, 7, 4.0)]
    assert heard_as_twins(*same_number) == [False, False, True, True]
    again = [(0.0, 7, 50.0), (1.0, 7, 51.0), (1.6, 9, 0.0), (2.0, 9, 0.4), (3.0, 9, 1.4), (3.1, 9, 1.5)]
    assert not any(heard_as_twins(*again))
    late = [(0.0, 7, 50.0), (3.0, 7, 51.0), (3.0, 7, 52.0), (3.1, 7, 53.0), (5.5, 7, 54.0)]
    assert not any(heard_as_twins(*late)), "a machine without time for its messages"


@pytest.mark.parametrize("service", ["slam", "navigator", "autopilot"])
def test_preflight_refuses_beside_a_second_process_of_a_service(service: str) -> None:
    hub = Hub(TreedockConfig())
    navigator = Navigator(cast("Context", hub.context("navigator")), NavigatorConfig(live_guard=False))
    navigator.register(20.0)
    state = VehicleState(**{**example(VehicleState).model_dump(), "connected": True, "note": ""})
    for second, (pid, uptime_s) in enumerate(((7, 50.0), (9, 3.0), (7, 51.0))):
        hub.clock.set_ns(second * 500_000_000 + 1)
        hub.context(service).publish(HEALTH, health(service, pid=pid, uptime_s=uptime_s), service)
        hub.context("autopilot").publish(VEHICLE_STATE, state)
        hub.run()
    navigator.step()
    assert f"{service}: runs twice" in " ".join(missing(navigator.mission.board, navigator.mission.config))


def test_preflight_looks_at_the_clocks_where_time_is_the_walls() -> None:
    hub, wall = Hub(TreedockConfig()), WallClock()
    context = hub.context("navigator")
    context.clock = wall  # type: ignore[assignment]
    navigator = Navigator(cast("Context", context), NavigatorConfig(live_guard=False))
    for off_s in (-1.2, 1.2, 0.0):
        navigator._on_health(health("slam", stamp_ns=wall.now_ns() + round(off_s * 1e9)))
        found = against_flight(tuple(navigator._aboard.values()), None, running_version())
        assert [f"{1e3 * off_s:+.0f} ms" in fault for fault in found if fault.startswith("clock")] == [True] * bool(
            off_s
        )
