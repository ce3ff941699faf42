"""What the doctor looks at on the machine itself, and what it mends."""

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
from types import SimpleNamespace
from typing import Any

import pytest

from services.cli.app import invoke
from services.cli.doctor import _mended
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.doctor.facts import gather
from services.doctor.findings import judge
from services.recorder.config import RecorderConfig
from services.router.radio import RadioWatch
from services.security.authority import Authority
from services.security.identity import Identity
from tests.unit.test_doctor import SOUND


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
    without = config.recorder.model_copy(update={"mcap": False})
    none = gather(config.model_copy(update={"recorder": without})).disk_free_bytes
    assert none is None, "the doctor's own advice to a full disk: nothing is recorded there"


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


@pytest.mark.parametrize(("identity", "wanted"), [("", {"slam", "recorder"}), ("station.alice", {"slam", "station"})])
def test_units_that_are_not_to_run_here_are_not_missed(
    monkeypatch: pytest.MonkeyPatch, identity: str, wanted: set[str]
) -> None:
    states = {"slam": "active", "recorder": "inactive", "station": "inactive", "fusion": "inactive"}
    listed = "".join(f"treedock-{name}.service loaded {state} dead what it is\n" for name, state in states.items())
    listed += "treedock-gone.service not-found inactive dead\n"
    monkeypatch.setattr("services.doctor.facts._said", lambda *words: listed if "list-units" in words else "")
    config = TreedockConfig.model_validate({"router": {"port": 1}, "security": {"identity": identity}})
    assert set(gather(config).units) == {f"treedock-{name}.service" for name in wanted}


def test_a_radio_that_is_not_there_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = {"folder": tmp_path, "radio_interfaces": ["lo", "wlan77"]}
    config = TreedockConfig.model_validate({"router": {"protocol": "tls", "port": 1}, "security": names})
    assert gather(config).radio_absent == ["wlan77"]
    looks = list[Callable[[], None]]()
    context: Any = SimpleNamespace(health=HealthBook(), every_wall=lambda _, look: looks.append(look))
    RadioWatch(config.security.radio_interfaces).register(context)
    looks[0]()
    assert "wlan77: no network interface here" in context.health.notes["radio"]
    assert caplog.text.count("wlan77") == 1
    RadioWatch(("lo",)).register(context)
    assert "radio" not in context.health.notes


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
