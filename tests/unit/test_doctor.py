"""The doctor: each trouble gives its finding with what to do, a sound machine none."""

from __future__ import annotations

import datetime as dt
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from schemas.health import Health
from schemas.topics import HEALTH, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.cli.app import invoke
from services.cli.doctor import _mended
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
from services.recorder.config import RecorderConfig
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
    units={"treedock-slam.service": "active"}, clock_synchronised=True, lockable_bytes=-1, shm_free_bytes=10**10,
    version="0.1.0+same", disk_free_bytes=10**11, camera="realsense: 4 video devices", source="realsense", calibration_days=20.0,
)  # fmt: skip
PX4 = ServiceFact("autopilot", "ready", 12, "", 0.2, {"vehicle/state": 20.0})
FLYING = replace(SOUND, services=(CAMERA, SLAM, PX4), vehicle=VehicleFact(connected=True, note="", battery_share=0.8))
WRONG = "parameters: EKF2_EV_CTRL is 0, expected 11: fuse vision position, height and yaw"
ENCRYPTED = replace(SOUND, encrypted=True, certificates={"uav1.slam": 200.0}, reachable_from_outside=True)


def test_a_sound_machine_has_no_trouble() -> None:
    for facts in (SOUND, ENCRYPTED, FLYING):
        assert {finding.level for finding in judge(facts)} == {"ok"}


@pytest.mark.parametrize(
    ("facts", "about", "level", "word"),
    [
        (replace(SOUND, router=None, services=()), "router", "fail", "7447"),
        (replace(SOUND, services=()), "services", "warn", "no service"),
        (replace(ENCRYPTED, services=()), "services", "warn", "or this certificate is revoked"),
        (replace(SOUND, units={"treedock-slam.service": "failed"}), "units", "fail", "treedock-slam"),
        (replace(SOUND, units={"treedock-slam.service": "inactive"}), "units", "warn", "stopped"),
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
    ENCRYPTED, station=True, services=(SLAM,), camera=None, source="realsense", disk_free_bytes=10**7, shm_free_bytes=10**7,
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
        (replace(STATION, services=()), "services", "start treedock-station.target"),
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


def test_a_camera_is_known_by_its_product_name_and_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "2-1"
    device.mkdir()
    (device / "product").write_text("Intel(R) RealSense(TM) Depth Camera 435i\n")
    (device / "speed").write_text("480\n")
    monkeypatch.setattr("services.doctor.facts.USB_DEVICES", tmp_path)
    facts = gather(TreedockConfig.model_validate({"camera": {"source": "realsense"}, "router": {"port": 1}}))
    assert (facts.camera, facts.camera_mbit) == ("Intel(R) RealSense(TM) Depth Camera 435i", 480.0)


def test_the_age_of_a_calibration_is_what_it_says_not_the_files(tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    day = dt.datetime.now(dt.UTC).date() - dt.timedelta(days=200)
    file.write_text(json.dumps({"calibration": {"day": day.isoformat()}}))
    config = TreedockConfig.model_validate({"camera": {"camera_file": str(file)}, "router": {"port": 1}})
    assert gather(config).calibration_days == 200.0
    file.write_text("{}")
    assert gather(config).calibration_days is None
    assert "camera.json: width" in gather(config).camera_fault
    file.unlink()
    assert str(file) in gather(config).camera_fault


def test_a_user_without_rights_is_told_so(tmp_path: Path) -> None:
    """What was seen on an installed machine: PermissionError, called a bug."""
    closed = tmp_path / "closed"
    (closed / "recordings").mkdir(parents=True)
    code = (
        "import os\n"
        "from pathlib import Path\n"
        "from services.doctor import facts\n"
        "from services.recorder import recover\n"
        "if os.geteuid() == 0:\n"
        "    os.setgroups([])\n"
        "    os.setuid(65534)\n"
        f"folder = Path({str(closed / 'recordings')!r})\n"
        "print(facts._closed((folder,)), facts._nearest(folder), facts._cut(folder))"
    )
    closed.chmod(0o000)
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    finally:
        closed.chmod(0o755)
    assert str(closed / "recordings") in done.stdout, done.stderr
    assert str(closed / "recordings") not in done.stdout.partition("]")[2]


def test_a_machine_is_really_looked_at(tmp_path: Path) -> None:
    now = dt.datetime.now(dt.UTC)
    authority = Authority.create(tmp_path, now)
    for name in ("uav1.slam", "uav1.reader"):
        authority = authority.issue(Identity.parse(name), now, days=10)
    (tmp_path / "uav1.slam.key").chmod(0o644)
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    (recordings / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    config = TreedockConfig.model_validate({
        "router": {"protocol": "tls", "port": 1}, "security": {"folder": tmp_path},
        "recorder": RecorderConfig(folder=recordings), "camera": {"source": "tum:/nowhere"},
    })  # fmt: skip
    facts = gather(config)
    assert facts.router is None
    assert facts.certificates["uav1.slam"] == pytest.approx(10.0, abs=0.1)
    assert facts.loose_keys == [str(tmp_path / "uav1.slam.key")]
    assert facts.recordings_cut == [str(recordings / "a.mcap")]
    assert facts.camera is None
    assert facts.disk_free_bytes is not None


def _nothing(folder: Path) -> None:
    shutil.rmtree(folder)


def _of_another_fleet(folder: Path) -> None:
    now = dt.datetime.now(dt.UTC)
    other = Authority.create(folder.parent / "other", now).issue(Identity.parse("uav1.slam"), now, days=100)
    for end in (".pem", ".key"):
        shutil.copy(other.folder / f"uav1.slam{end}", folder)


def _revoked(folder: Path) -> None:
    Authority.open(folder.parent / "fleet").revoke(Identity.parse("uav1.slam"))
    shutil.copy(folder.parent / "fleet/identities.json", folder)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_nothing, r"ca\.pem: No such file"),
        (_of_another_fleet, r"uav1\.slam\.pem: is of another authority"),
        (_revoked, r"uav1\.slam\.1 is revoked"),
        (lambda folder: (folder / "uav1.slam.pem").write_text("x"), r"uav1\.slam\.pem: damaged"),
        (lambda folder: (folder / "uav1.slam.key").unlink(), r"uav1\.slam\.key: No such file"),
        (lambda folder: (folder / "uav1.slam.pem").unlink(), "holds no node's certificate"),
        (lambda folder: (folder / "identities.json").write_text("x"), r"identities\.json: damaged"),
    ],
)
def test_certificates_that_would_be_refused_are_found(
    tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    now = dt.datetime.now(dt.UTC)
    slam = Identity.parse("uav1.slam")
    Authority.create(tmp_path / "fleet", now).issue(slam, now, days=100).export([slam], tmp_path / "certs")
    config = TreedockConfig.model_validate(
        {"router": {"protocol": "tls", "port": 1}, "security": {"folder": tmp_path / "certs"}}
    )
    about = "certificates"
    assert next(f for f in judge(gather(config)) if f.about == about).level == "ok"
    spoil(tmp_path / "certs")
    found = [f for f in judge(gather(config)) if f.about == "certificate"]
    assert [f.level for f in found] == ["fail"]
    assert re.search(words, found[0].text)
    assert found[0].do
    assert not any(f.about == about for f in judge(gather(config)))


@pytest.mark.parametrize("fault", [FileNotFoundError("systemctl"), subprocess.TimeoutExpired("systemctl", 10.0)])
def test_a_system_that_does_not_answer_is_no_bug(monkeypatch: pytest.MonkeyPatch, fault: Exception) -> None:
    def run(*_: object, **__: object) -> None:
        raise fault

    monkeypatch.setattr("subprocess.run", run)
    facts = gather(TreedockConfig.model_validate({"router": {"port": 1}}))
    assert (facts.units, facts.clock_synchronised, facts.station) == ({}, None, False)


def test_what_could_not_be_mended_is_not_called_fixed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 1, "", "Unit treedock-slam.service not found.\n")

    monkeypatch.setattr("subprocess.run", run)
    broken = tmp_path / "a.mcap"
    broken.write_bytes(b"not one at all")
    facts = replace(
        SOUND, loose_keys=("/nowhere/x.key",), recordings_cut=(str(broken),), units={"treedock-slam.service": "failed"}
    )
    assert not _mended(facts)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["not fixed"] * 3
    assert "No such file" in lines[0]
    assert lines[2] == "not fixed: systemctl restart treedock-slam.service: Unit treedock-slam.service not found."


def test_fix_mends_and_the_report_is_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    code = invoke(["doctor", "--fix", "--json", "--set", f"recorder.folder={tmp_path}", "--port", "1"])
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert code == 3, "no router"
    assert report["fit"] is False
    assert "cut.mcap" in said.err
    assert not any(finding["about"] == "recordings" for finding in report["findings"])
