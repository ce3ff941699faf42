"""Router, station and stub aircraft as real processes, and a page in Debian's Chromium."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from services.common.session import free_port

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROOT = Path(__file__).parents[2]
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""


@dataclass
class Ground:
    """The ground side: everything by name, so that a test can kill it."""

    folder: Path
    port: int = field(default_factory=free_port)
    page_port: int = field(default_factory=free_port)
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    settings: list[str] = field(default_factory=list)
    on_end: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    """What a test opened towards the station and has closed, whatever becomes of it."""

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.page_port}/"

    @property
    def database(self) -> Path:
        return self.folder / "inventory.gpkg"

    def _start(self, name: str, *command: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen([sys.executable, "-m", *command], cwd=ROOT, stdout=log, stderr=log)
        self.running[name] = process
        return process

    def router(self) -> None:
        self._start("router", "services.cli.app", "router", "--port", str(self.port))

    def station(self, *, answer: int = 200) -> None:
        """Start it and wait until its page answers with this HTTP status."""
        settings = [f"station.inventory.database={self.database}", *self.settings]
        flags = [part for setting in settings for part in ("--set", setting)]
        port = ["--port", str(self.port), "--page-port", str(self.page_port)]
        self._start("station", "services.cli.app", "station", *port, *flags)
        assert until(lambda: self._answers() == answer, 60.0), self.said("station")

    def _answers(self) -> int | None:
        try:
            with urllib.request.urlopen(self.address, timeout=1.0) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as refusal:
            with refusal:
                return refusal.code
        except OSError:
            return None

    def aircraft(self, uav: str, speed: int = 4, seed: int = 1) -> None:
        self._start(uav, "tests.station.stub_aircraft", str(self.port), uav, str(speed), str(seed))

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        process = self.running.pop(name)
        process.send_signal(number)
        process.wait(timeout=10.0)

    def pause(self, name: str, *, stop: bool) -> None:
        self.running[name].send_signal(signal.SIGSTOP if stop else signal.SIGCONT)

    def said(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def end(self) -> None:
        self.on_end.close()
        for process in self.running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()


def until(condition: Callable[[], bool], timeout_s: float = 10.0, pause_s: float = 0.05) -> bool:
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(pause_s)
    return False


@pytest.fixture
def ground(tmp_path: Path) -> Iterator[Ground]:
    """Router and station, without an aircraft."""
    ground = Ground(tmp_path)
    try:
        ground.router()
        ground.station()
        yield ground
    finally:
        ground.end()
    assert not [t.name for t in threading.enumerate() if "(keepalive)" in t.name or "(recv_events)" in t.name]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Debian's Chromium, driven by playwright."""
    if not CHROMIUM:
        pytest.skip("no chromium on this machine: apt-get install chromium, or name one with CHROMIUM")
    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    with sync.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@contextlib.contextmanager
def opened_page(browser: Browser, ground: Ground, **options: object) -> Iterator[Page]:
    """Open the station's page in a browser profile of its own; it must complain of nothing."""
    context = browser.new_context(viewport={"width": 1024, "height": 768}, **options)  # type: ignore[arg-type]
    page = context.new_page()
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda m: faults.append(m.text) if m.type == "error" and "WebSocket" not in m.text else None)
    page.goto(ground.address)
    try:
        yield page
    finally:
        context.close()
    assert not faults


@pytest.fixture
def page(browser: Browser, ground: Ground) -> Iterator[Page]:
    with opened_page(browser, ground) as page:
        yield page
