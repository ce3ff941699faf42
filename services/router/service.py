"""The router: a Zenoh session that all nodes of this machine meet at. It forwards; it has no work of its own."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh

from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.live_context import LiveContext
from services.common.runtime import run_service
from services.common.session import memory_settings, opened, router_config, split_endpoint, why_not_listen
from services.common.stop import StopSignal
from services.router.keeper import TimeKeeper
from services.router.radio import RadioWatch
from services.router.watch import RegisterWatch
from services.security.transport import router_settings

LOG = logging.getLogger(__name__)

_RUNTIME, _READERS = "ZENOH_RUNTIME", "(rx: (worker_threads: 32))"
"""Zenoh closes a connection with a linger of 10 s, and whoever closes one that is stuck waits for so long. A machine that is
out of reach leaves as many as it has services: with Zenoh's two threads of its own all others stood still for 10 s, 10 s after
a cable was pulled (its issue 1101; measured in tests/process/test_router_stuck.py)."""


@contextmanager
def listening(config: TreedockConfig) -> Iterator[zenoh.Session]:
    """Open the router's session where the configuration says.

    Raises:
        InputError: the port is taken, the address is not this machine's, or a certificate is missing.
    """
    os.environ.setdefault(_RUNTIME, _READERS)  # read when the first session is opened
    endpoint = config.router.listen_endpoint
    secured = router_settings(config.security, config.uav) | memory_settings(config)
    protocol, host, port = split_endpoint(endpoint)
    if protocol != "quic" and (why := why_not_listen(host, port)):
        raise InputError(why)
    with ExitStack() as stack:
        try:
            session = stack.enter_context(opened(router_config(endpoint, secured)))
        except zenoh.ZError as error:
            raise InputError(f"cannot listen on {endpoint}: {error}") from error
        yield session


def run(config: TreedockConfig, stop: StopSignal | None = None) -> int:
    """Run the router until it is stopped, or the list of certificates changes; return the exit code.

    A session's access rules cannot be changed: the router ends, and its supervisor (systemd, ``treedock run``) starts it
    with the new ones. Nodes are back within seconds, those that were revoked without any right.

    Raises:
        InputError: the port is taken, or a certificate is missing.
    """
    if stop is None:
        stop = StopSignal()
        stop.install()
    if config.security.folder is None and not config.router.local:
        LOG.warning("the bus is plain and open to other machines: whoever reaches it can command (docs/operations.md)")
    watch = RegisterWatch(config.security, stop.set)

    def build(context: LiveContext) -> None:
        watch.register(context)
        if config.security.folder is not None:  # on a plain bus nothing is held back anywhere
            RadioWatch(config.security.radio_interfaces).register(context)
        TimeKeeper(context, context.wall)

    return run_service("router", build, config, stop, session=lambda _: listening(config))
