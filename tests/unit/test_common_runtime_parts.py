"""Inbox, timers, health, notification, logging: the runtime's parts without a bus."""

from __future__ import annotations

import gc
import logging
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.codec import decode, encode
from schemas.health import Health
from services.cli.run_plan import with_port
from services.common import sd_notify
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.common.errors import InputError
from services.common.health import HealthReporter
from services.common.inbox import Inbox
from services.common.logging import Throttle, set_up
from services.common.memory import Hub
from services.common.process import give_back_memory, give_way, prepare_process
from services.common.session import free_port, split_endpoint, why_not_listen

ROOT = Path(__file__).parents[2]


def test_items_are_taken_in_order_of_arrival_across_mailboxes() -> None:
    inbox = Inbox()
    a, b = inbox.mailbox(print, 4), inbox.mailbox(print, 4)
    for box, item in ((a, 1), (b, 2), (a, 3)):
        inbox.put(box, item)
    taken = [inbox.take() for _ in range(4)]
    assert [t and t[1] for t in taken] == [1, 2, 3, None]


@given(st.lists(st.integers(), max_size=30), st.integers(min_value=1, max_value=5))
def test_a_mailbox_keeps_the_newest_and_counts_the_rest(items: list[int], capacity: int) -> None:
    inbox = Inbox()
    box = inbox.mailbox(print, capacity)
    for item in items:
        inbox.put(box, item)
    kept = []
    while (taken := inbox.take()) is not None:
        kept.append(taken[1])
    assert kept == items[-capacity:]
    assert box.overflowed == len(items) - len(kept)


def test_waiting_ends_with_an_item_or_a_wake() -> None:
    inbox = Inbox()
    box = inbox.mailbox(print, 1)
    for act in (lambda: inbox.put(box, 1), inbox.wake):
        timer = threading.Timer(0.05, act)
        timer.start()
        begin = time.monotonic()
        inbox.wait(5.0)
        assert time.monotonic() - begin < 2.0
        inbox.take()
        timer.join()
    inbox.wake()
    begin = time.monotonic()
    inbox.wait(5.0)
    assert time.monotonic() - begin < 1.0, "a wake before the wait is not lost"


@given(
    st.dictionaries(st.text(max_size=120), st.integers(-5, 10**12), max_size=200),
    st.dictionaries(st.text(max_size=20), st.lists(st.floats(), max_size=3), max_size=5),
    st.text(max_size=4000),
)
def test_any_book_makes_a_valid_health(counters: dict[str, int], stages: dict[str, list[float]], note: str) -> None:
    book = HealthBook()
    book.counters.update(counters)
    book.stage_ms.update(stages)
    book.note("camera/rgbd", note)
    health = HealthReporter("slam", book).report(1, {"slam/pose": 3})
    assert decode(Health, encode(health)) == health
    assert health.state == ("degraded" if note else "ready")


def test_rates_and_medians_are_of_the_time_since_the_last_report() -> None:
    book = HealthBook()
    reporter = HealthReporter("slam", book)
    book.stage_ms["track"] += [1.0, 9.0, 2.0]
    first = reporter.report(1, {"slam/pose": 10})
    assert first.work_ms == {"track": 2.0}
    assert first.rates_hz["slam/pose"] > 0
    second = reporter.report(2, {"slam/pose": 10}, waiting="waiting for vehicle/state")
    assert second.work_ms == {}
    assert second.rates_hz == {"slam/pose": 0.0}
    assert (second.seq, second.state, second.note) == (1, "ready", "waiting for vehicle/state")


def test_systemd_is_told_through_its_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        assert sd_notify.notify("READY=1")
        assert listener.recv(100) == b"READY=1"
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    assert not sd_notify.notify("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    assert not sd_notify.notify("READY=1")


def test_a_record_is_one_line_and_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        set_up("slam")
        set_up("slam")
        logging.getLogger("x").info("two\nlines")
        logging.getLogger("x").debug("not shown")
        said = capsys.readouterr().err
    finally:
        logging.captureWarnings(capture=False)
        root.handlers[:] = handlers
        root.setLevel(level)
    assert said.count("\n") == 1
    assert "slam INFO two | lines" in said


def test_a_repeated_record_comes_once_a_period(caplog: pytest.LogCaptureFixture) -> None:
    throttle, logger = Throttle(0.05), logging.getLogger("throttled")
    for _ in range(5):
        throttle.log(logger, logging.WARNING, "pose", "bad pose")
    throttle.log(logger, logging.WARNING, "trees", "bad trees")
    time.sleep(0.06)
    throttle.log(logger, logging.WARNING, "pose", "bad pose")
    said = [r.getMessage() for r in caplog.records if r.name == logger.name]
    assert said == ["bad pose", "bad trees", "bad pose (and 4 more like it)"]


@pytest.mark.parametrize("endpoint", ["", "tcp", "tcp/host", "tcp/host:0", "tcp/host:70000", "tcp/:1", "host:7447"])
def test_a_wrong_endpoint_is_told(endpoint: str) -> None:
    with pytest.raises(InputError, match="endpoint"):
        split_endpoint(endpoint)


def test_endpoints_and_ports() -> None:
    assert split_endpoint("tcp/127.0.0.1:7447") == ("tcp", "127.0.0.1", 7447)
    assert split_endpoint("tls/[::1]:1") == ("tls", "::1", 1)
    port = free_port()
    assert why_not_listen("127.0.0.1", port) == ""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        assert why_not_listen("127.0.0.1", port).startswith(f"port {port} on 127.0.0.1 is in use: ")


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("192.0.2.1", "is no address of this machine"),
        ("nobody.invalid", "is no known name"),
        ("localhost", ""),
        ("0.0.0.0", ""),
    ],
)
def test_an_address_that_is_not_ours_is_not_called_a_port_in_use(host: str, words: str) -> None:
    assert words in (why := why_not_listen(host, free_port()))
    assert bool(why) == bool(words)
    if words:
        tree = TreedockConfig.model_validate({"router": {"host": host}})
        with pytest.raises(InputError, match=words):
            with_port(tree, fixed=False)


def test_the_hub_stops_services_once_and_knows_its_listeners() -> None:
    from schemas.topics import SLAM_POSE, TREES_LIST

    hub = Hub(TreedockConfig())
    context = hub.context("slam")
    calls: list[str] = []
    context.on_stop(lambda: calls.append("stopped"))
    context.every_wall(1.0, lambda: calls.append("tick"))
    context.on(TREES_LIST, lambda _: None)
    hub.advance_to(2_500_000_000)
    hub.stop()
    hub.stop()
    assert calls == ["tick", "tick", "stopped"]
    assert context.listened(TREES_LIST)
    assert not context.listened(SLAM_POSE)


def test_a_sandbox_that_forbids_priorities_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """systemd's filter of resource calls answers EPERM: the mapping thread of slam ended at its first line."""

    asked: list[int] = []

    def forbidden(*_: int) -> None:
        asked.append(1)
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.setpriority", forbidden)
    give_way(5)
    assert asked == [1], "it was refused, once, and went on"


def test_somebody_without_a_home_has_kernels_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file/cache"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    before = gc.get_threshold()
    prepare_process()
    gc.set_threshold(*before)
    assert str(tmp_path) not in os.environ["NUMBA_CACHE_DIR"]


def test_what_a_full_queue_held_goes_back_to_the_machine() -> None:
    queued = [bytes(20_000) for _ in range(5_000)]
    full_mb = _resident_mb()
    last = queued.pop()  # it keeps the allocator from giving the rest back by itself
    queued.clear()
    give_back_memory()
    assert full_mb - _resident_mb() > 80.0
    assert len(last) == 20_000


@pytest.mark.parametrize("taken", [True, False])
def test_arrays_of_many_lengths_take_no_more_memory_once_it_is_taken(*, taken: bool) -> None:
    grown_mb = float(subprocess.check_output([sys.executable, "-c", _MANY_LENGTHS, str(taken)], cwd=ROOT))
    assert grown_mb < 1.0 if taken else grown_mb > 2.0, "without it there is growth, or this test shows nothing"


@pytest.mark.parametrize("taken", [True, False])
def test_a_busy_moment_takes_no_more_memory_once_its_room_is_taken(*, taken: bool) -> None:
    grown_mb = float(subprocess.check_output([sys.executable, "-c", _BUSY_MOMENT, str(taken)], cwd=ROOT))
    assert grown_mb < 0.5 if taken else grown_mb > 1.0, "without it there is growth, or this test shows nothing"


_BUSY_MOMENT = """
import resource, sys
from services.common.process import take_small_objects
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 1e6
if sys.argv[1] == "True":
    take_small_objects()
before = resident_mb()
moment = [(k, 0.5 * k) for k in range(10_000)]
print(resident_mb() - before)
"""

_MANY_LENGTHS = """
import resource, sys
import numpy as np
from services.common.process import take_small_arrays
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 1e6
lengths = np.random.default_rng(1).integers(1, 1024, 20_000).tolist()
if sys.argv[1] == "True":
    take_small_arrays()
before = resident_mb()
for length in lengths:
    masks = [np.zeros(length, bool) for _ in range(8)]
print(resident_mb() - before)
"""


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6
