"""The page where others reach it, asking browsers for a certificate: who has none of ours gets not even a refusal."""

from __future__ import annotations

import datetime as dt
import http.client
import ssl
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.security.authority import Authority
from services.security.identity import Identity
from services.station.config import StationConfig
from services.station.guard import Guard
from services.station.requests import Request
from services.station.server import WebServer, bound_socket
from services.station.web import Site


class Nobody:
    """Ears that listen to no page."""

    def opened(self, page: int, address: str) -> None: ...
    def closed(self, page: int) -> None: ...
    def said(self, page: int, request: Request) -> None: ...
    def misspoke(self, page: int, why: str) -> None: ...


def fleet(folder: Path, *names: str) -> Path:
    now = dt.datetime.now(dt.UTC)
    authority = Authority.create(folder, now)
    for name in names:
        authority = authority.issue(Identity.parse(name), now, hosts=("127.0.0.1",))
    return folder


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    ours = fleet(tmp_path / "ours", "station.ground", "station.anna")
    fleet(tmp_path / "others", "station.anna")
    config = StationConfig(
        host="0.0.0.0", port=0, tls_certificate=str(ours / "station.ground.pem"), tls_key=str(ours / "station.ground.key"),
        tls_client_ca=str(ours / "ca.pem"),
    )  # fmt: skip
    server = WebServer(Site(config, Guard("", local=config.local), Nobody()), config, bound_socket("127.0.0.1", 0))
    server.start()
    try:
        yield server.port
    finally:
        server.stop()


def status(port: int, trusted: Path, pair: Path | None) -> int:
    context = ssl.create_default_context(cafile=str(trusted))
    if pair is not None:
        context.load_cert_chain(f"{pair}.pem", f"{pair}.key")
    connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=10.0, context=context)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status
    finally:
        connection.close()


def test_only_certificates_of_our_own_authority_are_served(port: int, tmp_path: Path) -> None:
    ca = tmp_path / "ours" / "ca.pem"
    assert status(port, ca, tmp_path / "ours" / "station.anna") == 200
    for pair in (None, tmp_path / "others" / "station.anna"):
        with pytest.raises((ssl.SSLError, ConnectionError, http.client.RemoteDisconnected)):
            status(port, ca, pair)


def test_plain_http_gets_nothing(port: int) -> None:
    with pytest.raises((OSError, http.client.HTTPException)):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10.0)
