"""What the station asks aircraft for on threads of its own: an order never waits behind a cloud, nor is it carried out late."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from schemas.command import CommandReply, NonceReply
from schemas.sketch import SubmapSketch
from schemas.topics import COMMAND, COMMAND_NONCE, MAP_SKETCH, Topic
from services.common.config import TreedockConfig
from services.common.live_context import LiveContext
from services.inventory.config import InventoryConfig
from services.station.brain import Outgoing
from services.station.config import StationConfig
from services.station.service import Station


def sketch(number: int) -> SubmapSketch:
    return SubmapSketch(map_id="m1", submap_id=number, version=1, stamp_ns=1, T_map_submap=np.eye(4),
                        points_cm=np.zeros((3, 3), np.int16), colour=np.zeros((3, 3), np.uint8))  # fmt: skip


class StubBus:
    """An aircraft whose answers wait until the test lets them go."""

    def __init__(self) -> None:
        self.clouds, self.orders = threading.Semaphore(0), threading.Event()
        self.orders.set()
        self.nonce_asked, self.cloud_asked = threading.Event(), threading.Event()
        self.asked: list[str] = []
        self.asking: Counter[str] = Counter()
        self.most: Counter[str] = Counter()
        self.held: list[SubmapSketch] = []
        self._lock = threading.Lock()

    def ask(self, topic: Topic, request: object, kind: type, timeout_s: float, leaf: str | None = None) -> list[Any]:
        del request, kind, timeout_s
        with self._lock:
            self.asked.append(leaf or topic.name)
            self.asking[topic.name] += 1
            self.most[topic.name] = max(self.most[topic.name], self.asking[topic.name])
        try:
            if topic is MAP_SKETCH:
                self.cloud_asked.set()
                self.clouds.acquire(timeout=20.0)
                return list(self.held)
            if topic is COMMAND_NONCE:
                self.nonce_asked.set()
                self.orders.wait(20.0)
                return [NonceReply(nonce=b"n" * 16, valid_s=10.0, next_sequence=1)]
            assert topic is COMMAND
            return [CommandReply(accepted=True, reason="", state="hold")]
        finally:
            with self._lock:
                self.asking[topic.name] -= 1

    def subscribe(self, topic: Topic, handler: Callable[[Any], None]) -> None:
        del topic, handler

    def unsubscribe(self, topic: Topic) -> None:
        del topic


class Ground:
    """A station without bus and page, over stub aircraft; the test turns its work loop."""

    def __init__(self, **settings: Any) -> None:
        config = StationConfig(port=0, inventory=InventoryConfig(database="none"), **settings)
        self.context = LiveContext("station", TreedockConfig(station=config), None)  # type: ignore[arg-type]
        self.station = Station(self.context)
        self.buses: dict[str, StubBus] = {}
        self.answers: list[tuple[Outgoing, CommandReply | None]] = []
        self.told: list[int] = []
        self.station.brain.on_answer = lambda sent, reply: self.answers.append((sent, reply))  # type: ignore[method-assign]
        self.station.clouds._send = lambda page, *_: self.told.append(page)

    def aircraft(self, uav: str) -> StubBus:
        self.buses[uav] = self.station._buses[uav] = StubBus()  # type: ignore[assignment]
        self.station.brain.aircraft(uav)
        return self.buses[uav]

    def looks(self, page: int, uav: str) -> None:
        brain = self.station.brain
        if page not in brain.sessions:
            brain.on_open(page, "test")
        brain.sessions[page].cloud_of = uav
        if uav:
            brain.on_cloud_wish(uav)

    def order(self, uav: str, name: str) -> None:
        self.station._send_order(Outgoing(uav, name, None, "station.1", 1, 1, "operator"))  # type: ignore[arg-type]

    def until(self, condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
        end_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end_s:
                return False
            while (found := self.context.inbox.take()) is not None:
                found[0].handler(found[1])
            time.sleep(0.005)
        return True


@pytest.fixture
def made() -> Iterator[Callable[..., Ground]]:
    """Return what makes grounds; each is let go at the end."""
    grounds: list[Ground] = []

    def make(**settings: Any) -> Ground:
        grounds.append(Ground(**settings))
        return grounds[-1]

    yield make
    for ground in grounds:
        for bus in ground.buses.values():
            bus.clouds.release(100)
            bus.orders.set()
        ground.station._server._socket.close()
        ground.station._orders.shutdown(wait=False, cancel_futures=True)
        ground.station._stops.shutdown(wait=False, cancel_futures=True)
        ground.station.clouds.close()


def test_hold_goes_out_while_clouds_are_waited_for(made: Callable[..., Ground]) -> None:
    ground = made()
    for number in range(10):
        ground.aircraft(f"uav{number}")
        ground.looks(number, f"uav{number}")
    ground.order("uav0", "hold")
    assert ground.buses["uav0"].nonce_asked.wait(1.0)
    assert ground.until(lambda: bool(ground.answers))


def test_an_order_that_waited_is_refused_unless_it_makes_safe(made: Callable[..., Ground]) -> None:
    ground = made(view_stale_s=0.2)
    slow, other = ground.aircraft("uav1"), ground.aircraft("uav2")
    slow.orders.clear()
    for _ in range(8):
        ground.order("uav1", "next")
    for name in ("start", "hold", "land", "abort"):
        ground.order("uav2", name)
    assert ground.until(lambda: len(ground.answers) == 3), "what makes safe waits behind no other"
    assert ground.until(lambda: False, 0.4) is False
    slow.orders.set()
    assert ground.until(lambda: len(ground.answers) == 12)
    assert {name for name in other.asked if name != COMMAND_NONCE.name} == {"hold", "land", "abort"}
    reply = next(reply for sent, reply in ground.answers if sent.name == "start")
    assert reply is not None
    assert not reply.accepted
    assert "press again" in reply.reason


def test_a_cloud_is_asked_for_once_at_a_time_and_no_more_when_nobody_looks(made: Callable[..., Ground]) -> None:
    ground = made()
    bus = ground.aircraft("uav1")
    for page in range(5):
        ground.looks(page, "uav1")
    assert bus.cloud_asked.wait(1.0)
    time.sleep(0.1)
    assert bus.most[MAP_SKETCH.name] == 1
    for page in range(5):
        ground.looks(page, "")
    ground.station.clouds.each_second()
    bus.held = [sketch(1)]
    bus.clouds.release()
    ground.until(lambda: False, 0.3)
    assert bus.asked == [MAP_SKETCH.name]  # something new came, and nobody wants to know whether there is more
    assert not ground.told


def test_a_page_that_looks_while_another_ones_cloud_comes_gets_all_of_it(made: Callable[..., Ground]) -> None:
    ground = made()
    bus = ground.aircraft("uav1")
    bus.held = [sketch(number) for number in range(3)]
    ground.looks(1, "uav1")
    bus.clouds.release()
    assert ground.until(lambda: ground.told.count(1) == 3)
    assert ground.until(lambda: len(bus.asked) == 2)  # whether there is more
    ground.looks(2, "uav1")
    bus.clouds.release(100)
    assert ground.until(lambda: ground.told.count(2) == 3)
    assert ground.until(lambda: len(bus.asked) == 3 and not bus.asking[MAP_SKETCH.name])
