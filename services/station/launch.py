"""How ``treedock run`` has a station: which configuration it gets, where its page is, whether a browser opens it."""

from __future__ import annotations

import fcntl
import os
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from services.common.config import TreedockConfig

_ADDRESS_FILE = "station.address"
_WAIT_S = 120.0


def station_services() -> tuple[str, ...]:
    """Return the station's service, or nothing where its libraries are not installed: a run needs no page to fly."""
    return ("station",) if find_spec("starlette") and find_spec("uvicorn") and find_spec("websockets") else ()


def with_station(tree: TreedockConfig, folder: Path) -> TreedockConfig:
    """Return ``tree`` with a station that cannot keep the run from flying.

    Its page takes another port where the configured one is in use. A simulated run's trees are no trees of the world:
    their inventory lies in the run's ``folder``; so does it where another station writes to the user's own.
    """
    from services.inventory.store import default_path

    inventory = tree.station.inventory
    if not inventory.database and (tree.camera.source == "sim" or _in_use(default_path())):
        inventory = inventory.model_copy(update={"database": str(folder / "inventory.gpkg")})
    station = tree.station.model_copy(update={
        "inventory": inventory, "any_port": True, "address_file": str(folder / _ADDRESS_FILE), "open_browser": False,
    })  # fmt: skip
    return tree.model_copy(update={"station": station})


def _in_use(path: Path) -> bool:
    """Whether a station writes to this inventory now, or it cannot be written at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (path.parent / f".{path.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    return False


def announce(console: Console, folder: Path, *, browser: bool) -> None:
    """Say where the page is as soon as it is served, and open it where somebody sits at a screen."""
    begin_ns = time.time_ns()

    def wait() -> None:
        end_s = time.monotonic() + _WAIT_S
        while time.monotonic() < end_s:
            address = address_in(folder, begin_ns)
            if address:
                console.print(f"treedock: page on {address}", highlight=False)
                if browser and console.is_terminal:
                    open_browser(address)
                return
            time.sleep(0.2)

    threading.Thread(target=wait, name="announce", daemon=True).start()


def address_in(folder: Path, since_ns: int = 0) -> str:
    """Return the address that the station wrote into ``folder``, empty before it did."""
    path = folder / _ADDRESS_FILE
    try:
        return path.read_text().strip() if path.stat().st_mtime_ns >= since_ns else ""
    except OSError:
        return ""


def open_browser(address: str) -> None:
    """Open a browser where there is a screen; a headless machine has none."""
    if sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        import webbrowser

        webbrowser.open(address)
