"""Who may see the page, and what every answer carries."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import pytest

from services.security.authority import Authority
from services.security.config import SecurityConfig
from services.security.identity import Identity
from services.security.transport import pair_of
from services.station.config import StationConfig
from services.station.guard import HEADERS, Guard, cookie_of, host_name

TOKEN = "t" * 32


@pytest.mark.parametrize("host", ["127.0.0.1:8420", "localhost", "localhost:1", "[::1]:8420"])
def test_this_machine_is_let_in(host: str) -> None:
    assert Guard("", local=True).host_refusal(host) == ""


@pytest.mark.parametrize(
    "host", ["evil.example:8420", "127.0.0.1.evil.example", "", "localhost@evil.example", "10.0.0.1"]
)
def test_a_name_that_was_made_to_point_here_is_not(host: str) -> None:
    assert Guard("", local=True).host_refusal(host)


@pytest.mark.parametrize(
    "origin", [None, "", "null", "http://evil.example", "http://127.0.0.1:9", "http://127.0.0.1:8420.evil"]
)
def test_a_foreign_origin_opens_no_socket(origin: str | None) -> None:
    assert Guard("", local=True).origin_refusal(origin, "127.0.0.1:8420")


def test_the_pages_own_origin_does() -> None:
    assert Guard("", local=True).origin_refusal("http://127.0.0.1:8420", "127.0.0.1:8420") == ""


def test_the_token_is_asked_for() -> None:
    guard = Guard(TOKEN, local=False)
    assert guard.admits(f"other=1; treedock_station={TOKEN}")
    for header in (None, "", "treedock_station=", f"treedock_station={TOKEN[:-1]}", "treedock_station=ä", "=;;;"):
        assert not guard.admits(header)
    assert Guard("", local=True).admits(None)


def test_odd_headers_give_nothing() -> None:
    assert cookie_of("a=b; \x00=;;") is None
    assert host_name("[::1]:5") == "::1"


def test_no_script_but_our_own_files_may_run() -> None:
    policy = HEADERS["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy


def test_config_knows_what_is_local_and_what_belongs_together() -> None:
    assert StationConfig().local
    assert StationConfig(host="::1").local
    assert not StationConfig(host="0.0.0.0").local
    assert not StationConfig(host="field-box").local
    for bad in ({"token": "short"}, {"tls_certificate": "a"}, {"tls_client_ca": "a"}, {"token": "with space" * 3}):
        with pytest.raises(ValueError, match=r"token|tls"):
            StationConfig(**bad)  # type: ignore[arg-type]


def test_a_ground_station_shows_its_own_certificate_where_it_has_one(tmp_path: Path) -> None:
    now = dt.datetime(2026, 11, 1, tzinfo=dt.UTC)
    authority = Authority.create(tmp_path, now)
    for name in ("station.alice", "uav1.station", "uav1.slam"):
        authority.issue(Identity.parse(name), now)
    shown = {}
    for identity in ("station.alice", ""):
        security = SecurityConfig(folder=tmp_path, identity=identity)
        for service in ("station", "slam"):
            pair = pair_of(security, "uav1", service)
            assert pair is not None
            shown[identity, service] = pair.certificate.name
    assert shown == {
        ("station.alice", "station"): "station.alice.pem", ("station.alice", "slam"): "uav1.slam.pem",
        ("", "station"): "uav1.station.pem", ("", "slam"): "uav1.slam.pem",
    }  # fmt: skip
