"""The station's web side against forged, foreign, slow and hostile clients."""

from __future__ import annotations

import json
import signal
import socket
import struct
import time
import urllib.error
import urllib.request
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from schemas.health import Health
from schemas.navigation import MissionState
from schemas.topics import HEALTH, MAP_SKETCH, MISSION_STATE, PREFIX
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.session import opened_client
from services.evaluate.station_ground import page_socket
from services.station.config import StationConfig
from tests.station.conftest import Ground, until

if TYPE_CHECKING:
    from playwright.sync_api import Page

SECRET = "s" * 24
TOKEN = "k" * 32
HOSTILE = (
    "<img src=x onerror=\"document.body.dataset.hacked='yes'\"><script>document.body.dataset.hacked='yes'</script>"
)


class Client:
    """A browser's half of the WebSocket."""

    def __init__(self, ground: Ground, name: str = "test", **options: Any) -> None:
        self.socket = page_socket(ground.address, **options)
        ground.on_end.callback(self.socket.close)
        self.id = 0
        self.state: dict[str, Any] = {}
        self.events: list[str] = []
        self.say(t="hello", secret=SECRET, name=name)

    def say(self, **body: Any) -> None:
        self.socket.send(json.dumps(body))

    def hear(self, kind: str, timeout_s: float = 5.0) -> dict[str, Any]:
        end_s = time.monotonic() + timeout_s
        while True:
            message = self.socket.recv(timeout=max(0.01, end_s - time.monotonic()))
            if isinstance(message, bytes):
                continue
            body: dict[str, Any] = json.loads(message)
            if body["t"] == "state":
                self.state = body
            if body["t"] == "events":
                self.events += [item["text"] for item in body["items"]]
            if body["t"] == kind:
                return body

    def ask(self, **body: Any) -> dict[str, Any]:
        self.id += 1
        self.say(**{"id": self.id, **body})
        return self.hear("reply")

    def order(self, name: str, **more: Any) -> dict[str, Any]:
        self.hear("state")
        return self.ask(**{"t": "order", "uav": "uav1", "name": name, "seen": self.state["n"], **more})

    def aircraft(self) -> list[str]:
        self.hear("state")
        return [view["uav"] for view in self.state["aircraft"]]

    def mission(self) -> str | None:
        """The first aircraft's mission state as the station tells it next; None before it was heard."""
        self.hear("state")
        views = self.state["aircraft"]
        return views[0]["mission"]["state"] if views and views[0]["mission"] else None


def get(address: str, **headers: str) -> tuple[int, str]:
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=3.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_the_page_and_its_files_are_served_and_nothing_else(ground: Ground) -> None:
    assert "treedock" in get(ground.address)[1]
    assert get(ground.address + "static/js/main.js")[0] == 200
    for path in ("static/../service.py", "static/..%2fservice.py", "static//etc/passwd", "service.py", "inventory/x"):
        assert get(ground.address + path)[0] == 404, path
    assert get(ground.address, Host="evil.example")[0] == 403


def test_a_foreign_page_gets_no_socket(ground: Ground) -> None:
    for origin in ("http://evil.example", None):
        with pytest.raises((InvalidStatus, ConnectionClosed)), page_socket(ground.address, origin=origin) as socket:
            socket.recv(timeout=2.0)
    assert "refused a connection" in ground.said("station")


def test_on_an_address_that_others_reach_a_token_is_asked_for(ground: Ground) -> None:
    ground.kill("station", signal.SIGTERM)
    ground.settings = ["station.host=0.0.0.0", f"station.token={TOKEN}"]
    ground.station(answer=403)  # to whoever has no token
    assert until(lambda: f"?token={TOKEN}" in ground.said("station"))
    assert get(ground.address)[0] == 403
    assert get(ground.address, Cookie=f"treedock_station={TOKEN}")[0] == 200
    assert get(f"{ground.address}?token=wrong{TOKEN}")[0] == 403
    with pytest.raises((InvalidStatus, ConnectionClosed)):
        Client(ground).hear("welcome")
    client = Client(ground, headers={"Cookie": f"treedock_station={TOKEN}"})
    assert client.hear("welcome")["you"]["name"] == "test"


def test_forged_and_stale_requests_are_refused_and_logged(ground: Ground) -> None:
    ground.aircraft("uav1")
    client = Client(ground)
    assert until(lambda: client.mission() is not None)  # its token and its health may be heard before its mission
    assert client.aircraft() == ["uav1"]
    assert until(lambda: client.order("start")["accepted"])
    assert "stale" in client.ask(t="order", uav="uav1", name="resume", seen=0)["reason"]
    assert "repeated" in client.ask(t="order", uav="uav1", name="land", seen=client.state["n"], id=1)["reason"]
    client.say(t="order", uav="uav1", name="explode", seen=1, id=99)
    client.socket.send("]")
    client.socket.send(b"\x00\x01")
    assert until(lambda: client.hear("events") is not None and sum("forged or broken" in e for e in client.events) >= 3)
    assert client.mission() not in (None, "landing")
    assert client.ask(t="order", uav="uav1", name="land", seen=0)["accepted"], "a stop is never too late"


def test_a_flood_of_requests_ends_the_page_not_the_station(ground: Ground) -> None:
    flood = Client(ground)

    def pour() -> None:
        for number in range(5_000):
            flood.say(t="take", uav="uav1", id=number)
        flood.hear("never", 10.0)

    with pytest.raises(ConnectionClosed):
        pour()
    assert Client(ground, "next").hear("welcome")["you"]["name"] == "next"


def test_a_browser_that_stopped_reading_slows_nobody(ground: Ground) -> None:
    ground.aircraft("uav1")
    slow, quick = Client(ground, "slow"), Client(ground, "quick")
    assert until(lambda: quick.aircraft() == ["uav1"])
    slow.socket.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.socket.close_timeout = 0.1
    begin_s, heard = time.monotonic(), 0
    while time.monotonic() - begin_s < 4.0:  # slow is never read from
        quick.hear("state")
        heard += 1
    assert heard >= 16


def test_hostile_words_never_become_markup(ground: Ground, page: Page) -> None:
    with opened_client(f"tcp/127.0.0.1:{ground.port}", lambda: False, wait_s=5.0) as session:
        bus = Bus(session, "uav1", HealthBook())
        bus.declare_live("navigator")
        health = Health(service="navigator", stamp_ns=1, seq=1, state="degraded", pid=1, uptime_s=1.0, counters={}, rates_hz={}, work_ms={}, note=HOSTILE)  # fmt: skip
        mission = MissionState(
            stamp_ns=10, seq=1, map_id="m1", state="scan", previous="idle", since_ns=1, reason=HOSTILE, target_tree_id=None,
            visited_tree_ids=(), docked_count=0, distance_m=None, heading_error_rad=None, failsafe=HOSTILE[:90],
        )  # fmt: skip

        def told() -> bool:
            bus.publish(MISSION_STATE, mission)
            bus.publish(HEALTH, health, "navigator")
            return "<img" in page.inner_text("#mission-reason")

        assert until(told, 10.0, 0.2)
        page.evaluate(f"window.treedock.link.name = {json.dumps(HOSTILE[:30])}")
        for tab in ("#tab-log", "#tab-systems"):
            page.click(tab)
            page.wait_for_timeout(400)
        assert "onerror" in page.inner_text("#panel-systems")
        assert page.evaluate("document.querySelectorAll('img, script').length") == 2  # the page's own
        assert page.evaluate("document.body.dataset.hacked ?? ''") == ""


def test_the_cloud_is_sent_while_a_page_looks_and_only_then(ground: Ground) -> None:
    ground.aircraft("uav1")
    client = Client(ground)
    assert until(lambda: client.aircraft() == ["uav1"])
    assert client.ask(t="cloud", uav="uav1", on=True)["accepted"]
    counts: dict[int, int] = {}

    def whole() -> bool:
        frame = client.socket.recv(timeout=5.0)
        if isinstance(frame, bytes) and frame[:1] == b"C":
            number, _, count = struct.unpack_from("<III", frame, 2 + frame[1])
            counts[number] = count
        return sum(counts.values()) > 299_000

    assert until(whole, 20.0, 0.0)
    with opened_client(f"tcp/127.0.0.1:{ground.port}", lambda: False, wait_s=5.0) as session:
        bus = Bus(session, "uav1", HealthBook())
        assert until(lambda: bus.listened(MAP_SKETCH))
        assert client.ask(t="cloud", uav="uav1", on=False)["accepted"]
        assert until(lambda: not bus.listened(MAP_SKETCH)), "the radio carries what nobody looks at"
        assert client.ask(t="cloud", uav="uav1", on=True)["accepted"]
        assert until(lambda: bus.listened(MAP_SKETCH))


def test_a_router_alone_is_no_aircraft(ground: Ground) -> None:
    client = Client(ground)
    for _ in range(5):
        assert client.aircraft() == []
    ground.aircraft("uav1")
    assert until(lambda: client.aircraft() == ["uav1"])

    def router() -> list[bool]:
        client.hear("state")
        (view,) = client.state["aircraft"]
        return [alive for name, _, _, _, alive, _ in view["services"] if name == "router"]

    assert until(lambda: router() == [True]), "it was there before the aircraft: that is not 'gone'"


def test_strangers_keys_and_names_do_no_harm(ground: Ground) -> None:
    """Garbage on every key, tokens of a hundred aircraft, names that are no names."""
    ground.aircraft("uav1")
    client = Client(ground)
    assert until(lambda: client.aircraft() == ["uav1"])
    with ExitStack() as stack, opened_client(f"tcp/127.0.0.1:{ground.port}", lambda: False, wait_s=5.0) as session:
        tokens = [session.liveliness().declare_token(f"{PREFIX}/x{n}/live/slam") for n in range(100)]
        names = ("a" * 500, "ü", "a b")
        tokens += [session.liveliness().declare_token(f"{PREFIX}/{name}/live/slam") for name in names]
        for key in (
            "slam/pose",
            "mission/state",
            "vehicle/state",
            "trees/list",
            "health/slam",
            "preview/image",
            "trees/target",
        ):
            for junk in (b"", b"\xff" * 100, b"\x81\xa1" * 50, bytes(100_000)):
                session.put(f"{PREFIX}/uav1/{key}", junk)
        assert until(lambda: len(client.aircraft()) == StationConfig().max_aircraft, 10.0)
        assert "uav1" in client.aircraft()
        assert all(len(uav) <= 64 for uav in client.aircraft())
        for token in tokens:
            token.undeclare()
        stack.close()
    assert ground.running["station"].poll() is None
    assert "bug" not in ground.said("station")
