"""Router and station as processes of their own, and a page without a browser: for the station's benchmark."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.common.errors import GoalNotReachedError
from services.common.session import free_port

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection


class Ground:
    """Router and station as processes of their own, in a folder."""

    def __init__(self, folder: Path, settings: tuple[str, ...] = ()) -> None:
        """Make it; ``settings`` of the station, ``name=value``."""
        self.folder = folder
        self._settings = [part for setting in settings for part in ("--set", setting)]
        self.port, self.page_port = free_port(), free_port()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def endpoint(self) -> str:
        """The router's address."""
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://127.0.0.1:{self.page_port}/"

    @property
    def database(self) -> Path:
        """The inventory's file."""
        return self.folder / "inventory.gpkg"

    def start(self, name: str) -> None:
        """Start the router or the station."""
        more = [] if name == "router" else ["--page-port", str(self.page_port), "--set",
                                            f"station.inventory.database={self.database}", *self._settings]  # fmt: skip
        command = [sys.executable, "-m", "services.cli.app", name, "--port", str(self.port), *more]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        """End one of them."""
        process = self.processes.pop(name)
        process.send_signal(number)
        process.wait(10.0)

    def served(self) -> bool:
        """Whether the page answers."""
        with suppress(OSError), urllib.request.urlopen(self.address, timeout=0.5) as answer:
            return bool(answer.status == 200)
        return False

    def close(self) -> None:
        """End both."""
        for name in list(self.processes):
            self.kill(name)


def until(condition: Callable[[], bool], timeout_s: float, pause_s: float = 0.05) -> float:
    """Return the seconds until ``condition`` held.

    Raises:
        GoalNotReachedError: it did not in time.
    """
    begin_s = time.monotonic()
    while not condition():
        if time.monotonic() - begin_s > timeout_s:
            raise GoalNotReachedError(f"bench station: not reached within {timeout_s:g} s")
        time.sleep(pause_s)
    return time.monotonic() - begin_s


def page_socket(
    address: str, *, origin: str | None = "its own", headers: Mapping[str, str] | None = None
) -> ClientConnection:
    """Return the WebSocket that the page at ``address`` would open; whoever opens it closes it.

    It sends no pings of its own: the thread that does outlives a socket that was forgotten, and logs into what comes after.

    Raises:
        OSError, TimeoutError: nobody serves it.
        websockets.WebSocketException: the station refuses.
    """
    from websockets.sync.client import connect
    from websockets.typing import Origin

    site = address.rstrip("/") if origin == "its own" else origin
    return connect(
        address.replace("http", "ws", 1) + "ws", origin=None if site is None else Origin(site), additional_headers=headers,
        max_size=None, ping_interval=None, close_timeout=1.0, legacy=True,
    )  # fmt: skip


class Page:
    """A page without a browser: its WebSocket, and what it was told."""

    def __init__(self, ground: Ground) -> None:
        self._socket = page_socket(ground.address)
        self._socket.send(json.dumps({"t": "hello", "secret": "b" * 24, "name": "bench"}))
        self.trees: dict[str, int] = {}
        self.states = 0
        """How often it was told the state of all aircraft."""
        self.links: dict[str, str] = {}

    def hear(self, timeout_s: float) -> None:
        """Take one frame."""
        frame = self._socket.recv(timeout=timeout_s)
        body: dict[str, Any] = json.loads(frame) if isinstance(frame, str) else {"t": ""}
        if body["t"] == "trees":
            self.trees[body["uav"]] = len(body["rows"])
        elif body["t"] == "state":
            self.states += 1
            self.links = {view["uav"]: view["link"] for view in body["aircraft"]}

    def right(self, aircraft: int, trees: int) -> bool:
        """Whether it shows all aircraft with good links and all their trees."""
        return (
            len(self.links) == aircraft
            and set(self.links.values()) == {"good"}
            and list(self.trees.values()) == [trees] * aircraft
        )

    def close(self) -> None:
        """Close it."""
        self._socket.close()
