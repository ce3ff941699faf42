"""The router: a Zenoh session that all nodes of this machine meet at. It forwards; it has no work of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh

from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.runtime import run_service
from services.common.session import opened, port_is_free, router_config, split_endpoint
from services.common.stop import StopSignal


@contextmanager
def listening(endpoint: str) -> Iterator[zenoh.Session]:
    """Open the router's session on ``endpoint``.

    Raises:
        InputError: the port is taken or the address is not this machine's.
    """
    _, host, port = split_endpoint(endpoint)
    if not port_is_free(host, port):
        raise InputError(f"port {port} on {host} is in use: stop what listens there, or choose another with --port")
    with ExitStack() as stack:
        try:
            session = stack.enter_context(opened(router_config(endpoint)))
        except zenoh.ZError as error:
            raise InputError(f"cannot listen on {endpoint}: {error}") from error
        yield session


def run(config: TreedockConfig, stop: StopSignal | None = None) -> int:
    """Run the router until it is stopped; return the exit code.

    Raises:
        InputError: the port is taken.
    """
    endpoint = config.router.endpoint
    return run_service("router", lambda _: None, config, stop, session=lambda _: listening(endpoint))
