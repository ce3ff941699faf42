"""Identities, rights and the certificate authority."""

from __future__ import annotations

import datetime as dt
import json
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest
from cryptography import x509
from hypothesis import given
from hypothesis import strategies as st

from schemas.topics import TOPICS, Delivery, Reach, find
from services.cli.app import invoke
from services.common.config_loader import load
from services.common.context import HealthBook
from services.common.errors import InputError
from services.security.access import access_control, radio_rules, rights_of
from services.security.authority import Authority
from services.security.config import SecurityConfig
from services.security.expiry import Expiry, told_days_left
from services.security.identity import ROLES, Identity
from services.security.register import Register
from services.security.transport import node_settings, pair_of, router_settings

ROOT = Path(__file__).parents[2]
NOW = dt.datetime(2026, 11, 1, tzinfo=dt.UTC)


@pytest.mark.parametrize(
    "text", ["", "slam", "uav1.", "uav1.pilot", "a/b.slam", "uav1.slam.2", "*.slam", "station.", "station.a/b"]
)
def test_what_is_no_identity_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match=r"uav1\.slam"):
        Identity.parse(text)


@given(st.text(max_size=20))
def test_an_identity_never_widens_a_key(text: str) -> None:
    try:
        identity = Identity.parse(text)
    except InputError:
        return
    if identity.role != "station":
        assert not set("*$/#?") & set(identity.uav)


def test_a_service_speaks_only_its_own_keys() -> None:
    rights = rights_of(Identity.parse("uav1.slam"))
    assert set(rights.publish) == {
        f"treedock/v1/uav1/{n}" for n in ("slam/pose", "slam/keyframe", "slam/graph", "health/slam")
    }
    assert rights.live == ("treedock/v1/uav1/live/slam",)
    assert "treedock/v1/uav1/camera/rgbd" in rights.subscribe
    assert not any("cmd" in key or "sim/truth" in key for key in (*rights.ask, *rights.answer, *rights.subscribe))


def test_a_station_hears_the_radio_keys_of_all_aircraft_and_orders() -> None:
    rights = rights_of(Identity.parse("station.alice"))
    assert rights.publish == ("treedock/v1/*/health/station",)
    heard = {key.removeprefix("treedock/v1/*/") for key in rights.subscribe}
    assert heard == {t.name for t in TOPICS if t.reach is Reach.RADIO and t.delivery is not Delivery.QUERY}
    assert "treedock/v1/*/cmd/*" in rights.ask


def test_only_the_navigator_answers_orders_and_a_reader_says_nothing() -> None:
    answering = [
        r for r in ROLES if r != "station" and "treedock/v1/u/cmd/*" in rights_of(Identity.parse(f"u.{r}")).answer
    ]
    assert answering == ["navigator"]
    reader = rights_of(Identity.parse("uav1.reader"))
    assert reader.publish == reader.answer == reader.live == ()


def test_truth_is_for_evaluation_alone() -> None:
    hearing = [
        r
        for r in ROLES
        if r != "station" and "treedock/v1/u/sim/truth" in rights_of(Identity.parse(f"u.{r}")).subscribe
    ]
    assert set(hearing) <= {"evaluate", "reader", "recorder"}


def test_the_generated_section_denies_by_default_and_names_only_valid_certificates() -> None:
    section = access_control({"uav1.slam.2": Identity.parse("uav1.slam")})
    assert section["enabled"] is True
    assert section["default_permission"] == "deny"
    assert section["subjects"] == [{"id": "uav1.slam.2", "cert_common_names": ["uav1.slam.2"]}]
    nobody = access_control({})
    assert nobody["enabled"] is True
    assert nobody["default_permission"] == "deny"


def test_radio_rules_thin_and_limit_what_the_table_names() -> None:
    assert radio_rules(()) == {}
    rules = radio_rules(("wlan0",))
    text = json.dumps(rules)
    assert '"key_expr": "treedock/v1/*/slam/pose", "freq": 5' in text
    limits = {
        key: rule["size_limit"] for rule in cast("list[Any]", rules["low_pass_filter"]) for key in rule["key_exprs"]
    }
    assert {topic.key("*") for topic in TOPICS if limits[topic.key("*")] == 0} == {
        topic.key("*") for topic in TOPICS if topic.reach is not Reach.RADIO
    }
    assert find("slam/pose").max_bytes <= 64 * 1024


def test_issue_renew_revoke(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "ca", NOW)
    slam = Identity.parse("uav1.slam")
    authority = authority.issue(slam, NOW, hosts=("127.0.0.1",))
    assert list(authority.register.valid_names()) == ["uav1.slam.1"]
    authority = Authority.open(tmp_path / "ca").issue(slam, NOW)
    assert list(authority.register.valid_names()) == ["uav1.slam.2"], "the renewed one replaces the first"
    certificate = x509.load_pem_x509_certificate((tmp_path / "ca/uav1.slam.pem").read_bytes())
    assert certificate.not_valid_after_utc == NOW + dt.timedelta(days=397)
    certificate.verify_directly_issued_by(authority.certificate)
    assert authority.revoke(slam).register.valid_names() == {}
    with pytest.raises(InputError, match="no valid certificate"):
        Authority.open(tmp_path / "ca").revoke(slam)


def test_keys_are_for_their_owner_and_the_authoritys_stays(tmp_path: Path) -> None:
    slam = Identity.parse("uav1.slam")
    authority = Authority.create(tmp_path / "ca", NOW).issue(slam, NOW)
    authority.export([slam], tmp_path / "machine")
    names = {path.name for path in (tmp_path / "machine").iterdir()}
    assert names == {"ca.pem", "identities.json", "uav1.slam.pem", "uav1.slam.key"}
    for key in (*(tmp_path / "machine").glob("*.key"), *(tmp_path / "ca").glob("*.key")):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    with pytest.raises(InputError, match=r"uav1\.mapper"):
        authority.export([Identity.parse("uav1.mapper")], tmp_path / "machine")


def test_an_authority_is_never_made_twice_nor_outlived(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path, NOW, days=100)
    with pytest.raises(InputError, match="already holds"):
        Authority.create(tmp_path, NOW)
    with pytest.raises(InputError, match=r"2027-02-09.*--days 100 at most"):
        authority.issue(Identity.parse("uav1.slam"), NOW, days=101)
    with pytest.raises(InputError, match=r"own end \(2027-02-09\): make a new one"):
        authority.issue(Identity.parse("uav1.slam"), NOW + dt.timedelta(days=200), days=1)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"version": 2, "issued": []}', '{"version": 1, "issued": [{}]}', "\x00"]
)
def test_a_damaged_list_is_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / Register.FILE).write_text(text)
    with pytest.raises(InputError, match=r"identities\.json"):
        Register.read(tmp_path)


def test_settings_name_the_files_and_a_missing_one_is_told(tmp_path: Path) -> None:
    security = SecurityConfig(folder=tmp_path)
    assert node_settings(pair_of(SecurityConfig(), "uav1", "slam")) == {}
    assert router_settings(SecurityConfig(), "uav1") == {}
    with pytest.raises(InputError, match=r"ca\.pem.*certs issue uav1\.slam"):
        pair_of(security, "uav1", "slam")
    authority = Authority.create(tmp_path, NOW).issue(Identity.parse("uav1.slam"), NOW)
    authority.issue(Identity.parse("uav1.router"), NOW)
    settings = node_settings(pair_of(security, "uav1", "slam"))
    assert settings["transport/link/tls/enable_mtls"] is True
    router = router_settings(security, "uav1")
    assert isinstance(router["access_control"], dict)
    assert router["access_control"]["enabled"] is True


@pytest.mark.parametrize("flags", [["router.protocol=tls"], ["security.folder=/etc/x"]])
def test_half_an_encrypted_bus_is_refused(tmp_path: Path, flags: list[str]) -> None:
    with pytest.raises(InputError, match=r"security\.folder"):
        load(flags=flags, environ={}, system_directory=tmp_path)


def test_the_command_line_walks_through(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = ["--folder", str(tmp_path / "ca")]
    assert invoke(["certs", "init", *at]) == 0
    assert invoke(["certs", "issue", "uav1.all", "station.alice", *at]) == 0
    assert invoke(["certs", "revoke", "uav1.mapper", *at]) == 0
    assert invoke(["certs", "renew", "station.alice", *at]) == 0
    capsys.readouterr()
    assert invoke(["certs", "list", "--json", *at]) == 0
    entries = json.loads(capsys.readouterr().out)
    assert {e["identity"] for e in entries if e["revoked"]} == {"uav1.mapper", "station.alice"}
    assert [e["revoked"] for e in entries if e["identity"] == "station.alice"] == [True, False]
    assert invoke(["certs", "export", "uav1.all", "--to", str(tmp_path / "m"), *at]) == 0
    assert not (tmp_path / "m/uav1.mapper.key").exists()
    assert (tmp_path / "m/uav1.slam.key").exists()
    assert invoke(["certs", "issue", "uav1.pilot", *at]) == 2
    assert invoke(["certs", "list", "--folder", str(tmp_path / "nowhere")]) == 2


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """An authority that knows one aircraft's slam and a station."""
    for arguments in (["init"], ["issue", "uav1.slam", "station.alice"]):
        assert invoke(["certs", *arguments, "--folder", str(tmp_path / "fleet")]) == 0
    return tmp_path / "fleet"


@pytest.mark.parametrize("arguments", [
    ["revoke", "uav9.all"], ["renew", "uav9.all"], ["export", "uav9.all", "--to", "TO"], ["issue", "station.all"],
    ["revoke", "station.alice", "station.bob"], ["renew", "uav1.slam", "uav1.camera"], ["issue", "uav1.slam", "nonsense"],
    ["issue", "uav1.slam", "--host", ""], ["issue", "uav1.slam", "--host", "two words"], ["issue", "uav1.slam", "--host", "10.0.0"],
    ["issue", "uav1.slam", "--host", "m\u00fcnchen"], ["issue", "uav1.slam", "--days", "99999999999"],
])  # fmt: skip
def test_what_cannot_be_done_whole_is_refused_and_nothing_is_done(
    fleet: Path, tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in fleet.iterdir()}
    capsys.readouterr()
    given = [str(tmp_path / "to") if argument == "TO" else argument for argument in arguments]
    assert invoke(["certs", *given, "--folder", str(fleet)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("treedock: ")
    assert {path: path.read_bytes() for path in fleet.iterdir()} == before
    assert not (tmp_path / "to").exists()


@pytest.mark.parametrize(("mode", "told"), [(0o600, False), (0o644, True), (0o640, True)])
def test_a_fleets_secret_that_others_can_read_is_told(
    fleet: Path, capsys: pytest.CaptureFixture[str], *, mode: int, told: bool
) -> None:
    (fleet / "ca.key").chmod(mode)
    assert invoke(["certs", "issue", "uav1.slam", "--folder", str(fleet)]) == 0
    assert ("can be read by others" in capsys.readouterr().err) == told


def test_what_was_revoked_is_not_exported(fleet: Path, tmp_path: Path) -> None:
    assert invoke(["certs", "revoke", "station.all", "--folder", str(fleet)]) == 0
    assert invoke(["certs", "export", "station.alice", "--folder", str(fleet), "--to", str(tmp_path / "to")]) == 2
    assert not (tmp_path / "to").exists()


def test_who_may_only_look_is_told_so_instead_of_waiting_for_an_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["--set", f"security.folder={tmp_path}", "--set", "router.protocol=tls", "--port", "1"]
    assert invoke(["command", "land", *settings]) == 2
    assert "uav1.reader may only look" in capsys.readouterr().err
    assert invoke(["command", "land", *settings, "--set", "security.identity=station.alice"]) == 2
    assert "station.alice" in capsys.readouterr().err


def test_two_who_issue_at_once_lose_no_entry(fleet: Path) -> None:
    names = [f"uav{number}.slam" for number in range(10, 18)]
    command = [sys.executable, "-m", "services.cli.app", "certs", "issue", "--folder", str(fleet)]
    running = [subprocess.Popen([*command, name], cwd=ROOT, stdout=subprocess.DEVNULL) for name in names]
    assert [process.wait() for process in running] == [0] * len(names)
    assert set(names) <= {entry.identity for entry in Register.read(fleet).entries}


def test_health_tells_the_end_of_a_certificate_that_was_renewed_since(tmp_path: Path) -> None:
    slam, book = Identity.parse("uav1.slam"), HealthBook()

    def told(expiry: Expiry) -> float:
        expiry.tell(book, NOW)
        return told_days_left(book.counters) or 0.0

    authority = Authority.create(tmp_path, NOW).issue(slam, NOW, days=1)
    expiry = Expiry(SecurityConfig(folder=tmp_path), "uav1", "slam")
    assert told(expiry) == pytest.approx(1.0, abs=0.001)
    whole = (tmp_path / Register.FILE).read_text()
    (tmp_path / Register.FILE).write_text("half of it")
    assert told(expiry) == pytest.approx(1.0, abs=0.001)
    (tmp_path / Register.FILE).write_text(whole)
    authority.issue(slam, NOW, days=397)
    assert told(expiry) > 300.0
