"""Zenoh sessions as treedock opens them: nodes are clients of a router, no scouting, nothing implicit."""

from __future__ import annotations

import errno
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING

import zenoh

from schemas.camera import RgbdFrame
from schemas.topics import TOPICS, Reach
from services.common.errors import InputError
from services.common.memlock import lockable_bytes, too_little

if TYPE_CHECKING:
    from services.common.config import TreedockConfig

LOG = logging.getLogger(__name__)

_CLOSE_TIMEOUT_S = 0.5
_RETRY_S = 0.1
_SOURCE_LINE = re.compile(r" at \S+\.rs:\d+")
"""Zenoh's errors name the line of its own code."""
_PRIORITIES = (
    "control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background",
)  # fmt: skip
_QUEUE_BATCHES = 16
"""Sent messages that may wait per priority, the most Zenoh allows. Of 420 small messages in bursts of seven, up to 6
were lost per subscriber on a loaded two-core machine with the default of 2, none with 16."""
_TELL_AFTER_S = 2.0
_FRAME_SENDERS = frozenset(
    topic.producer for topic in TOPICS if topic.message is RgbdFrame and topic.reach is Reach.HOST
)
_SMALL_POOL_BYTES = 4 * 1024 * 1024
"""A keyframe is 0.15 MB, a submap up to 1 MB, the graph of 500 keyframes 50 KB."""


def client_config(endpoint: str, secured: Mapping[str, object] | None = None) -> zenoh.Config:
    """Return the configuration of a node.

    Args:
        endpoint: of the router, for example ``tcp/127.0.0.1:7447``.
        secured: what ``services.security.transport.node_settings`` adds.
    """
    return _config({
        **(secured or {}),
        "mode": "client",
        "connect/endpoints": [endpoint],
        # lost routers are looked for at short, steady intervals: back within a second of its return
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
    })  # fmt: skip


def router_config(endpoint: str, secured: Mapping[str, object] | None = None) -> zenoh.Config:
    """Return the configuration of the router that listens on ``endpoint``; ``secured`` of ``router_settings``."""
    return _config({**(secured or {}), "mode": "router", "listen/endpoints": [endpoint]})


def _config(values: dict[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    common: dict[str, object] = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # milliseconds; the default waits half a second at each open
        "timestamping/enabled": True,  # the advanced publisher's late joiners need it
    }
    for priority in _PRIORITIES:
        common[f"transport/link/tx/queue/size/{priority}"] = _QUEUE_BATCHES
    for key, value in {**common, **values}.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def opened(config: zenoh.Config) -> Iterator[zenoh.Session]:
    """Open a session and close it whatever happens: an unclosed one hangs the process at its end.

    Raises:
        zenoh.ZError: when the router cannot be reached or the address cannot be listened on.
    """
    session: zenoh.Session = zenoh.open(config)
    try:
        yield session
    finally:
        closing = threading.Thread(target=session.close, daemon=True)
        closing.start()
        closing.join(_CLOSE_TIMEOUT_S)
        if closing.is_alive():
            LOG.warning("the bus session did not close within %.1f s and is abandoned", _CLOSE_TIMEOUT_S)


def opened_node(
    config: TreedockConfig, service: str | None, stopped: Callable[[], bool], wait_s: float = float("inf")
) -> AbstractContextManager[zenoh.Session]:
    """Open the session of a service, or of a tool of the command line (``service`` None), as configured.

    Raises:
        InputError: a certificate is missing, or no router answers in ``wait_s`` seconds.
    """
    from services.security.transport import node_settings, pair_of

    settings = node_settings(pair_of(config.security, config.uav, service)) | memory_settings(config, service)
    return opened_client(config.router.endpoint, stopped, wait_s, settings)


def memory_settings(config: TreedockConfig, service: str | None = None) -> dict[str, object]:
    """Return what switches Zenoh's shared memory on or off, and how much of it a service (None: a tool, the router) sends from.

    Whoever sends raw frames keeps Zenoh's own 16 MB, ten frames; for all others it would be memory that stays locked and is never used.
    What does not fit goes over the socket.
    """
    settings: dict[str, object] = {"transport/shared_memory/enabled": config.router.shared_memory}
    if service is not None and service not in _FRAME_SENDERS:
        settings["transport/shared_memory/transport_optimization/pool_size"] = _SMALL_POOL_BYTES
    return settings


@contextmanager
def opened_client(
    endpoint: str,
    stopped: Callable[[], bool],
    wait_s: float = float("inf"),
    secured: Mapping[str, object] | None = None,
) -> Iterator[zenoh.Session]:
    """Open a client session, waiting for the router up to ``wait_s`` seconds or until ``stopped()``.

    Raises:
        InputError: no router in that time; the text says how to start one.
    """
    begin = time.monotonic()
    told = False
    while not _reachable(endpoint):
        if stopped() or time.monotonic() - begin > wait_s:
            raise InputError(f"no router answers at {endpoint}: start `treedock run` or `treedock router`")
        if not told and time.monotonic() - begin > _TELL_AFTER_S:
            LOG.warning("waiting for a router at %s", endpoint)
            told = True
        time.sleep(_RETRY_S)
    with ExitStack() as stack:
        try:
            session = stack.enter_context(opened(client_config(endpoint, secured)))
        except zenoh.ZError as error:
            hint = (
                "does it want certificates (router.protocol, security.folder)?"
                if endpoint.startswith("tcp/")
                else "is this certificate of its authority and not expired, and the address one of its --host?"
            )
            said = _SOURCE_LINE.sub("", str(error)).rstrip(".")
            raise InputError(f"the router at {endpoint} refused the session: {said}; {hint}") from error
        yield session


def split_endpoint(endpoint: str) -> tuple[str, str, int]:
    """Return protocol, host and port of an endpoint such as ``tcp/127.0.0.1:7447``.

    Raises:
        InputError: when it does not look like one.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if not (protocol and host and port.isdigit() and 0 < int(port) < 65536):
        raise InputError(f"{endpoint!r} is no endpoint: expected protocol/host:port, for example tcp/127.0.0.1:7447")
    return protocol, host.strip("[]"), int(port)


def _reachable(endpoint: str) -> bool:
    """Whether something listens there: asked by a bare connection, cheaper than a failed session."""
    protocol, host, port = split_endpoint(endpoint)
    if protocol not in {"tcp", "tls"}:
        return True
    try:
        with socket.create_connection((host, port), timeout=1.0):
            return True
    except OSError:
        return False


def why_not_listen(host: str, port: int) -> str:
    """Return why a router could not listen on this TCP address, with what to do; empty when it could."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except socket.gaierror as error:
        return f"{host} is no known name ({error.strerror}): give router.listen_host an address of this machine"
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return f"port {port} on {host} is in use: stop what listens there, or choose another with --port"
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{host} is no address of this machine: give router.listen_host one, or 0.0.0.0 for all"
        return f"cannot listen on port {port} of {host}: {error.strerror}"
    return ""


def free_port(host: str = "127.0.0.1") -> int:
    """Return a TCP port that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def shared_memory_note() -> str:
    """Return what keeps Zenoh's shared memory off in this process, or an empty text.

    Its segments are locked in memory; where the limit is too small it is silently off and big frames cost four times as much.
    """
    lockable = lockable_bytes()
    if lockable is None or not too_little(lockable):
        return ""
    return (
        f"shared memory is off: {lockable // 1024} KB may be locked; raise it (ulimit -l, LimitMEMLOCK=), or give "
        "CAP_IPC_LOCK, for cheap frames"
    )
