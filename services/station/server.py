"""The web server on its own thread: it never holds the work loop up, and ends with the process."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import threading

import uvicorn

from services.common.errors import InputError
from services.station.config import StationConfig
from services.station.requests import MAX_BYTES
from services.station.web import Site

LOG = logging.getLogger(__name__)

_STOP_WITHIN_S = 0.4


def bound_socket(host: str, port: int, *, any_port: bool = False) -> socket.socket:
    """Return a socket bound to the page's address; with ``any_port`` to another port where this one is in use.

    Raises:
        InputError: the address is not ours or the port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        if any_port and port:
            return bound_socket(host, 0)
        raise InputError(
            f"the page cannot be served on {host} port {port}: {error.strerror}; choose others with --host and --page-port"
        ) from error
    return bound


class WebServer:
    """Serves a site until it is stopped."""

    def __init__(self, site: Site, config: StationConfig, bound: socket.socket) -> None:
        self._site = site
        self._socket = bound
        logging.getLogger("uvicorn").setLevel(logging.WARNING)  # each page that opens would be three lines
        try:
            self._server = uvicorn.Server(_uvicorn_config(site, config))
            self._server.config.load()
        except (OSError, ssl.SSLError) as error:
            raise InputError(f"station.tls_*: the certificate files cannot be used: {error}") from error
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)
        self._up = threading.Event()

    @property
    def port(self) -> int:
        """The port that is served."""
        return int(self._socket.getsockname()[1])

    def start(self) -> None:
        """Begin to serve; return once requests are taken."""
        self._thread.start()
        self._up.wait(10.0)

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._site.loop = asyncio.get_running_loop()
        serving = asyncio.create_task(self._server.serve(sockets=[self._socket]))
        while not self._server.started and not serving.done():
            await asyncio.sleep(0.005)
        self._up.set()
        await serving

    def stop(self) -> None:
        """End it, without waiting for browsers."""
        self._server.should_exit = True
        self._server.force_exit = True
        self._thread.join(_STOP_WITHIN_S)


def _uvicorn_config(site: Site, config: StationConfig) -> uvicorn.Config:
    required = ssl.CERT_REQUIRED if config.tls_client_ca else ssl.CERT_NONE
    return uvicorn.Config(
        site.app, log_config=None, access_log=False, lifespan="off", server_header=False, date_header=False,
        http="h11", ws="websockets-sansio", ws_max_size=MAX_BYTES * 2, ws_max_queue=16, ws_per_message_deflate=False,
        proxy_headers=False, ws_ping_interval=2.0, ws_ping_timeout=5.0, limit_concurrency=config.max_browsers * 4 + 16, timeout_keep_alive=5,
        ssl_certfile=config.tls_certificate or None, ssl_keyfile=config.tls_key or None,
        ssl_ca_certs=config.tls_client_ca or None, ssl_cert_reqs=required,
    )  # fmt: skip
