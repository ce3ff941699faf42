"""The ground station under load: CPU, memory, messages lost, the page's frame rate; restarts; power cuts."""

from __future__ import annotations

import sqlite3
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import psutil

from schemas.health import Health
from schemas.topics import HEALTH
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.errors import GoalNotReachedError
from services.common.session import opened_client
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.station_cuts import cuts, figures_of
from services.evaluate.station_ground import Ground, Page, until
from services.evaluate.station_load import Load

_AIRCRAFT, _RATE_HZ, _TREES = 10, 5.0, 500
_MEASURE_S, _QUICK_S = 20.0, 8.0
_KILLS, _QUICK_KILLS = 100, 5
_STILL_S = 3.0
_CODE = (
    "services.station",
    "services.inventory",
    "services.common",
    "services.router",
    "schemas",
    "services.evaluate.bench_station",
)


def run(options: BenchOptions) -> BenchReport:
    """Measure load, restarts and power cuts."""
    seed = options.seed or 0
    seconds = _QUICK_S if options.quick else _MEASURE_S
    kills = options.count or (_QUICK_KILLS if options.quick else _KILLS)
    figures: dict[str, float] = {"aircraft": _AIRCRAFT}
    version = code_version(_CODE)
    cut_rows = cuts(options, kills, version)
    with ExitStack() as stack:
        ground = Ground(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="treedock-bench-"))))
        stack.callback(ground.close)
        ground.start("router")
        ground.start("station")
        load = stack.enter_context(Load(ground.endpoint, _AIRCRAFT, _RATE_HZ, _TREES, seed))
        figures |= _load(ground, load, seconds, options.tell)
        figures |= _restarts(ground, load, options.tell)
        load.go(on=False)
    figures |= figures_of(cut_rows)
    conditions = {
        "load": f"{_AIRCRAFT} aircraft, each {_RATE_HZ:g} Hz of pose, mission, vehicle, target and a list of {_TREES} trees, "
        f"all of them moved by noise of 4 mm; {seconds:g} s; one page open",
        "power cuts": f"{kills} times kill -9 of the station at a random moment, one aircraft with 50 trees; taken up where an earlier call stopped",
        "code": version,
        "seed": str(seed),
    }  # fmt: skip
    return BenchReport(figures, conditions, _table(figures))


def _load(ground: Ground, load: Load, seconds: float, tell: Callable[[str], None]) -> dict[str, float]:
    until(ground.served, 30.0)
    health: dict[str, Health] = {}

    def take(message: Health) -> None:
        health[message.service] = message

    with opened_client(ground.endpoint, lambda: False, wait_s=10.0) as session:
        bus = Bus(session, "uav1", HealthBook())
        bus.subscribe(HEALTH, take)

        def counted() -> int:
            while (taken := bus.inbox.take()) is not None:
                taken[0].handler(taken[1])
            return health["station"].counters.get("messages", 0) if "station" in health else -1

        load.go(on=True)
        until(lambda: counted() > 500, 30.0)
        load.go(on=False)
        before = _at_rest(counted)
        sent = load.sent
        page = psutil.Process(ground.processes["station"].pid)
        cpu_s, begin_s = sum(page.cpu_times()[:2]), time.monotonic()
        load.go(on=True)
        fps = _frame_rate(ground, seconds)
        load.go(on=False)
        used_s, took_s = sum(page.cpu_times()[:2]) - cpu_s, time.monotonic() - begin_s
        taken = _at_rest(counted) - before
        lost = (load.sent - sent) - taken
        load.go(on=True)
        figures = {
            "messages_sent": load.sent - sent, "messages_lost": lost, "cpu_cores": round(used_s / took_s, 3),
            "memory_mb": round(page.memory_info().rss / 1e6, 1), "rate_hz": round((load.sent - sent) / took_s / 5 / _AIRCRAFT, 2),
        }  # fmt: skip
    if fps is not None:
        figures["page_fps"] = round(fps, 1)
    dropped = {k: n for k, n in health["station"].counters.items() if k.startswith(("dropped", "decode"))}
    tell(f"load: {figures}, the station's own count of gaps: {dropped or 'none'}")
    return figures


def _at_rest(counted: Callable[[], int], timeout_s: float = 30.0) -> int:
    """Return the count once it has stood still for longer than the station's health takes to come (a busy machine lags)."""
    end_s = time.monotonic() + timeout_s
    last, since_s = counted(), time.monotonic()
    while time.monotonic() < min(end_s, since_s + _STILL_S):
        time.sleep(0.1)
        if (now := counted()) != last:
            last, since_s = now, time.monotonic()
    return last


def _frame_rate(ground: Ground, seconds: float) -> float | None:
    """Keep a page open for ``seconds``; return its frames per second in Chromium, None where there is none."""
    end_s = time.monotonic() + seconds
    try:
        import shutil

        from playwright.sync_api import sync_playwright

        path = shutil.which("chromium")
        if path is None:
            raise ImportError("no chromium")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
            page = browser.new_page(viewport={"width": 1024, "height": 768})
            page.goto(ground.address)
            page.wait_for_timeout(2_000)
            before, begin_s = page.evaluate("window.treedock.frames"), time.monotonic()
            page.wait_for_timeout(max(1.0, end_s - time.monotonic()) * 1e3)
            fps = (page.evaluate("window.treedock.frames") - before) / (time.monotonic() - begin_s)
            browser.close()
            return float(fps)
    except ImportError:
        with closing(Page(ground)) as page_without_browser:
            while time.monotonic() < end_s:
                page_without_browser.hear(2.0)
        return None


def _right_after(ground: Ground, timeout_s: float = 20.0) -> float:
    """Return the seconds until a page that opens now shows everything, trying again as the page itself does."""
    from websockets.exceptions import WebSocketException

    begin_s = time.monotonic()
    while time.monotonic() - begin_s < timeout_s:
        with suppress(OSError, TimeoutError, WebSocketException), closing(Page(ground)) as page:
            while not page.right(_AIRCRAFT, _TREES):
                page.hear(1.0)
            return time.monotonic() - begin_s
        time.sleep(0.1)
    raise GoalNotReachedError(f"bench station: the page was not right within {timeout_s:g} s")


def _restarts(ground: Ground, load: Load, tell: Callable[[str], None]) -> dict[str, float]:
    figures = {"reopened_s": _right_after(ground)}
    ground.kill("station")
    ground.start("station")
    figures["station_restart_s"] = _right_after(ground)
    ground.kill("router")
    time.sleep(1.0)
    ground.start("router")
    figures["router_restart_s"] = _right_after(ground)
    time.sleep(2.0)
    load.go(on=False)
    time.sleep(2.0)
    trees = _present(ground.database)
    figures["trees_lost"] = max(0, _AIRCRAFT * _TREES - trees)
    figures["trees_doubled"] = max(0, trees - _AIRCRAFT * _TREES)
    figures["database_mb"] = round(ground.database.stat().st_size / 1e6, 1)
    tell(f"restarts: {figures}")
    return {name: round(value, 2) for name, value in figures.items()}


def _present(path: Path) -> int:
    db = sqlite3.connect(path)
    try:
        return int(db.execute("SELECT count(*) FROM trees_local WHERE status = 'present'").fetchone()[0])
    finally:
        db.close()


_ROWS = (
    ("messages lost of those sent", "messages_lost", "0"), ("station CPU, cores", "cpu_cores", "<= 0.5"),
    ("station memory, MB", "memory_mb", ""), ("page frame rate in Chromium, 1/s", "page_fps", ""),
    ("page right after it was opened, s", "reopened_s", "<= 3"), ("after the station was restarted, s", "station_restart_s", "<= 3"),
    ("after the router was restarted, s", "router_restart_s", "<= 3"), ("trees lost", "trees_lost", "0"),
    ("trees doubled", "trees_doubled", "0"), ("files broken by kill -9", "files_broken", "0"),
    ("most that was missing after it, s", "missing_s_max", "<= 1"),
)  # fmt: skip


def _table(figures: dict[str, float]) -> str:
    lines = ["| | measured | wanted |", "|---|---|---|"]
    lines += [f"| {words} | {figures[name]:g} | {wanted} |" for words, name, wanted in _ROWS if name in figures]
    return "\n".join(lines)
