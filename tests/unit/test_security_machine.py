"""Certificates on their way to a machine: only a whole, valid set of one authority arrives."""

from __future__ import annotations

import datetime as dt
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from services.cli.app import invoke
from services.common.errors import InputError
from services.security.authority import Authority
from services.security.identity import Identity
from services.security.machine import bring, faults_in
from services.security.register import Register

NOW = dt.datetime(2026, 11, 1, tzinfo=dt.UTC)
SLAM, CAMERA = Identity.parse("uav1.slam"), Identity.parse("uav1.camera")


@pytest.fixture
def stick(tmp_path: Path) -> Path:
    """What was exported for a machine with two services."""
    authority = Authority.create(tmp_path / "fleet", NOW).issue(SLAM, NOW).issue(CAMERA, NOW)
    authority.export([SLAM, CAMERA], tmp_path / "stick")
    return tmp_path / "stick"


def test_a_sound_set_arrives_whole_and_closed_to_others(stick: Path, tmp_path: Path) -> None:
    files = bring(stick, tmp_path / "certs", NOW).files
    assert {path.name for path in files} == {path.name for path in stick.iterdir()}
    assert all(path.read_bytes() == (stick / path.name).read_bytes() for path in files)
    assert all(path.stat().st_mode & 0o077 == 0 for path in files if path.suffix == ".key")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_what_root_brings_belongs_to_the_services_user(stick: Path, tmp_path: Path) -> None:
    (tmp_path / "certs").mkdir()
    os.chown(tmp_path / "certs", 4711, 4711)
    assert {path.stat().st_uid for path in bring(stick, tmp_path / "certs", NOW).files} == {4711}


def _other_authority(stick: Path) -> None:
    other = Authority.create(stick.parent / "other", NOW).issue(SLAM, NOW)
    shutil.copy(other.folder / "uav1.slam.pem", stick)


def _swapped(stick: Path) -> None:
    shutil.copy(stick / "uav1.camera.key", stick / "uav1.slam.key")


def _renewed_since(stick: Path) -> None:
    fleet = stick.parent / "fleet"
    Authority.open(fleet).issue(SLAM, NOW)
    shutil.copy(fleet / "identities.json", stick)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda stick: (stick / "ca.key").write_text("secret"), "authority's own key"),
        (lambda stick: (stick / "ca.pem").unlink(), r"ca\.pem"),
        (lambda stick: (stick / "identities.json").unlink(), r"identities\.json"),
        (lambda stick: (stick / "uav1.slam.key").unlink(), r"uav1\.slam\.key"),
        (lambda stick: (stick / "uav1.slam.key").write_text("x"), "damaged"),
        (lambda stick: (stick / "uav1.slam.pem").write_text("x"), "damaged"),
        (_other_authority, "another authority"),
        (_swapped, "does not belong"),
        (_renewed_since, r"uav1\.slam\.1 is revoked .*; export it again"),
    ],
)
def test_an_unsound_set_is_refused_and_nothing_changes(
    stick: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    spoil(stick)
    with pytest.raises(InputError, match=words):
        bring(stick, tmp_path / "certs", NOW)
    assert not (tmp_path / "certs").exists()


def test_a_revoked_pair_stays_behind_on_the_stick_and_leaves_the_machine(
    stick: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    certs = tmp_path / "certs"
    bring(stick, certs, NOW)
    authority = Authority.open(tmp_path / "fleet").revoke(CAMERA).issue(SLAM, NOW)
    authority.export([SLAM], stick)
    shutil.copy(stick / Register.FILE, certs)
    assert any("rm " in fault and "uav1.camera.key" in fault for fault in faults_in(certs))
    assert invoke(["certs", "import", str(stick), "--to", str(certs)]) == 0
    assert "removed where they were: uav1.camera\n" in capsys.readouterr().out
    assert faults_in(certs) == []
    assert not list(certs.glob("uav1.camera.*"))
    assert (stick / "uav1.camera.pem").exists()


def test_one_that_was_renewed_elsewhere_stays_until_its_own_comes(stick: Path, tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    bring(stick, certs, NOW)
    Authority.open(tmp_path / "fleet").issue(CAMERA, NOW).export([SLAM], tmp_path / "other")
    assert not bring(tmp_path / "other", certs, NOW).revoked
    (fault,) = faults_in(certs)
    assert "uav1.camera.1 is revoked" in fault
    assert "rm " not in fault


@pytest.mark.parametrize("way", ["import", "export"])
def test_the_list_comes_last_as_a_running_router_starts_anew_with_it(
    stick: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    written: list[str] = []

    def write(path: Path, body: bytes, *_: int) -> None:
        written.append(path.name)
        path.write_bytes(body)

    for module in ("machine", "authority"):
        monkeypatch.setattr(f"services.security.{module}.write_whole", write)
    if way == "import":
        bring(stick, tmp_path / "certs", NOW)
    else:
        Authority.open(tmp_path / "fleet").export([SLAM, CAMERA], tmp_path / "again")
    assert written[-1] == Register.FILE
    assert set(written) == {path.name for path in stick.iterdir()}


@pytest.mark.parametrize(
    ("name", "target"), [("uav1.slam", "treedock.target"), ("station.alice", "treedock-station.target")]
)
def test_the_command_says_what_to_restart_where_pairs_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, target: str
) -> None:
    fleet, stick, certs = (str(tmp_path / place) for place in ("fleet", "stick", "certs"))
    assert invoke(["certs", "init", "--folder", fleet]) == 0
    for again in (False, True):
        assert invoke(["certs", "issue", name, "--folder", fleet]) == 0
        assert invoke(["certs", "export", name, "--folder", fleet, "--to", stick]) == 0
        capsys.readouterr()
        assert invoke(["certs", "import", stick, "--to", certs]) == 0
        assert (f"systemctl restart {target}" in capsys.readouterr().out) == again
    assert invoke(["certs", "import", stick, "--to", certs]) == 0
    assert "restart" not in capsys.readouterr().out


def _renamed(stick: Path) -> None:
    for end in (".pem", ".key"):
        shutil.copy(stick / f"uav1.camera{end}", stick / f"uav1.slam{end}")


def test_a_certificate_under_another_name_is_refused(stick: Path, tmp_path: Path) -> None:
    _renamed(stick)
    with pytest.raises(InputError, match=r"uav1\.slam\.pem: is the certificate of uav1\.camera"):
        bring(stick, tmp_path / "certs", NOW)


def test_an_old_stick_gives_no_revoked_certificate_its_rights_back(stick: Path, tmp_path: Path) -> None:
    fleet, certs = tmp_path / "fleet", tmp_path / "certs"
    alice = Identity.parse("station.alice")
    authority = Authority.open(fleet).issue(alice, NOW)
    authority.export([SLAM], tmp_path / "before")
    authority.revoke(alice).export([SLAM], tmp_path / "after")
    bring(tmp_path / "after", certs, NOW)
    bring(tmp_path / "after", certs, NOW)
    for old, words in ((tmp_path / "before", "revoked since"), (stick, "issued since")):
        with pytest.raises(InputError, match=rf"{old / 'identities.json'}: is old, station\.alice\.1 was {words}"):
            bring(old, certs, NOW)
        assert "station.alice.1" not in Register.read(certs).valid_names()
    (certs / Register.FILE).write_text("damaged")
    bring(tmp_path / "after", certs, NOW)


def test_another_authority_leaves_no_pair_behind_that_nobody_believes(stick: Path, tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    bring(stick, certs, NOW)
    other = Authority.create(tmp_path / "other", NOW).issue(SLAM, NOW).issue(CAMERA, NOW)
    other.export([SLAM], tmp_path / "half")
    with pytest.raises(InputError, match=r"another authority .*, and uav1\.camera\.pem there"):
        bring(tmp_path / "half", certs, NOW)
    other.export([SLAM, CAMERA], tmp_path / "whole")
    assert bring(tmp_path / "whole", certs, NOW).files


def test_what_has_expired_is_refused(stick: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expired"):
        bring(stick, tmp_path / "certs", NOW + dt.timedelta(days=400))


def test_the_command_says_what_comes_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet, stick, certs = (str(tmp_path / name) for name in ("fleet", "stick", "certs"))
    assert invoke(["certs", "init", "--folder", fleet]) == 0
    assert invoke(["certs", "issue", "uav1.slam", "--folder", fleet]) == 0
    assert invoke(["certs", "export", "uav1.slam", "--folder", fleet, "--to", stick]) == 0
    assert "certs import" in capsys.readouterr().out
    assert invoke(["certs", "import", stick, "--to", certs]) == 0
    assert 'protocol = "tls"' in capsys.readouterr().out
