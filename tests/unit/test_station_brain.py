"""The station's decisions: orders, who is in command, what pages are told, what is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.command import CommandReply
from schemas.envelope import DecodeError
from schemas.fusion import EarthPlace, FusionState
from schemas.health import Health
from schemas.navigation import MissionState
from schemas.orders import STOPS, CommandName
from schemas.slam import Pose
from schemas.topics import MISSION_STATE, SLAM_POSE, TREES_LIST, VEHICLE_STATE
from schemas.trees import TreeList
from services.common.geometry import level_camera, to_transform
from services.station.ages import LinkAges
from services.station.brain import Brain, Outgoing
from services.station.config import StationConfig
from services.station.outbox import Outbox
from services.station.preview import frame_of
from services.station.requests import MAX_BYTES, Hello, Order, parse
from services.station.trail import Trail
from tests.unit.navigator_world import tree

SECRET = "a" * 24


@dataclass
class FakePages:
    """Keeps what each page was told."""

    told: list[tuple[int, dict[str, Any]]] = field(default_factory=list)

    def latest(self, key: str, text: str) -> None:
        del key
        self.told.append((0, json.loads(text)))

    def each(self, text: str) -> None:
        self.told.append((0, json.loads(text)))

    def one(self, page: int, text: str) -> None:
        self.told.append((page, json.loads(text)))

    def last(self, kind: str, page: int | None = None) -> dict[str, Any]:
        return next(m for p, m in reversed(self.told) if m["t"] == kind and page in (None, p))


def fused(**changes: Any) -> FusionState:
    nothing = (0.0, 0.0, 0.0)
    values: dict[str, Any] = {
        "stamp_ns": 1, "seq": 1, "map_id": "m1", "carrier": "camera", "carried_s": 0.0, "gps": "trusted", "gps_word": "",
        "place": None, "accel_bias_m_s2": nothing, "gyro_bias_rad_s": nothing, "restarts": 0, "jumps_announced": 0,
    }  # fmt: skip
    return FusionState(**{**values, **changes})


class Desk:
    """A brain with an aircraft, pages that listen and orders that wait."""

    def __init__(self, **config: Any) -> None:
        self.pages = FakePages()
        self.orders: list[Outgoing] = []
        self.now_s = 100.0
        self.brain = Brain(StationConfig(**config), self.pages, self.orders.append, lambda: 1_700_000_000_000_000_000)
        self.brain.aircraft("uav1")
        self.ids: dict[int, int] = {}

    def join(self, page: int, name: str, secret: str = "") -> None:
        self.brain.on_open(page, "127.0.0.1")
        hello = Hello(t="hello", secret=secret or name.ljust(24, "x"), name=name)
        self.brain.on_request(page, hello, self.now_s)

    def ask(self, page: int, **request: Any) -> dict[str, Any]:
        self.ids[page] = self.ids.get(page, 0) + 1
        body = {"id": self.ids[page], "uav": "uav1", **request}
        self.brain.on_request(page, parse(json.dumps(body)), self.now_s)
        return (
            {}
            if body["t"] == "order" and self.orders and self.orders[-1].page == page
            else self.pages.last("reply", page)
        )

    def order(self, page: int, name: str, **more: Any) -> dict[str, Any]:
        self.brain.tell_state(self.now_s)
        return self.ask(page, **{"t": "order", "name": name, "seen": self.brain._state, **more})

    def log(self) -> list[str]:
        return [event.text for event in self.brain.log.latest()]


def mission(state: str = "idle", since_ns: int = 1, **more: Any) -> MissionState:
    body = {
        "stamp_ns": 10, "seq": 1, "map_id": "m1", "state": state, "previous": "idle", "since_ns": since_ns,
        "reason": "because", "target_tree_id": None, "visited_tree_ids": (), "docked_count": 0, "distance_m": None,
        "heading_error_rad": None, **more,
    }  # fmt: skip
    return MissionState(**body)


def pose(x_m: float, map_id: str = "m1") -> Pose:
    return Pose(stamp_ns=1, seq=1, map_id=map_id, status="tracking", T_map_camera=to_transform(level_camera([x_m, 0, 1], 0.1)),
                covariance=None, reset_counter=0, graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=9,
                up_sigma_rad=0.0, processing_ms=1.0)  # fmt: skip


# -- orders


def test_an_order_goes_out_and_its_answer_comes_back_and_both_are_logged() -> None:
    desk = Desk()
    desk.join(1, "Anna")
    desk.order(1, "start")
    assert [(o.uav, o.name, o.sender) for o in desk.orders] == [("uav1", "start", "station.1")]
    desk.brain.on_answer(
        desk.orders[0], CommandReply(accepted=False, reason="no word from the autopilot", state="idle")
    )
    assert desk.pages.last("reply", 1) == {
        "t": "reply",
        "id": 1,
        "accepted": False,
        "reason": "no word from the autopilot",
    }
    assert "Anna: start: refused: no word from the autopilot" in desk.log()
    desk.brain.on_answer(desk.orders[0], None)
    assert "may or may not have arrived" in desk.pages.last("reply", 1)["reason"]


def test_the_first_order_takes_command_and_nobody_else_may_then_order_but_hold() -> None:
    desk = Desk()
    desk.join(1, "Anna")
    desk.join(2, "Ben")
    desk.order(1, "start")
    assert "Anna is in command" in desk.order(2, "land")["reason"]
    assert len(desk.orders) == 1
    desk.order(2, "hold")
    assert desk.orders[-1].name == "hold"
    assert desk.brain.desk.commander("uav1").name == "Anna"  # type: ignore[union-attr]
    assert desk.ask(2, t="take")["accepted"]
    assert "Ben is in command" in desk.order(1, "land")["reason"]
    assert "Ben takes command from Anna" in desk.log()


def test_command_is_handed_over_given_back_and_lost_when_its_holder_is_gone() -> None:
    desk = Desk(keep_command_s=10.0)
    desk.join(1, "Anna")
    desk.join(2, "Ben")
    desk.ask(1, t="take")
    assert not desk.ask(2, t="hand_over", to=1)["accepted"]
    assert desk.ask(1, t="hand_over", to=2)["accepted"]
    assert desk.ask(2, t="release")["accepted"]
    assert not desk.ask(2, t="release")["accepted"]
    desk.ask(1, t="take")
    desk.brain.on_close(1, desk.now_s)
    desk.brain.tell_state(desk.now_s + 9.0)
    assert desk.brain.desk.commander("uav1") is not None
    desk.join(1, "Anna")  # the same browser came back in time
    desk.brain.tell_state(desk.now_s + 30.0)
    assert desk.brain.desk.commander("uav1") is not None
    desk.brain.on_close(1, desk.now_s)
    desk.brain.tell_state(desk.now_s + 11.0)
    assert desk.brain.desk.commander("uav1") is None
    assert "Anna is gone: nobody is in command" in desk.log()


def test_an_order_from_a_page_that_shows_an_old_state_is_refused_and_logged() -> None:
    desk = Desk(view_stale_s=3.0)
    desk.join(1, "Anna")
    desk.brain.tell_state(desk.now_s)
    seen = desk.brain._state
    for _ in range(5):
        desk.now_s += 1.0
        desk.brain.tell_state(desk.now_s)
    assert "stale" in desk.ask(1, t="order", name="start", seen=seen)["reason"]
    assert "stale" in desk.ask(1, t="order", name="start", seen=10**9)["reason"]
    assert not desk.orders
    assert sum("refused by the station: stale" in line for line in desk.log()) == 2


@pytest.mark.parametrize("stop", sorted(STOPS))
@pytest.mark.parametrize("seen", [1, 10**9])
def test_a_stop_passes_however_old_the_state_that_the_page_shows(stop: str, seen: int) -> None:
    desk = Desk(view_stale_s=3.0)
    desk.join(1, "Anna")
    desk.now_s += 60.0
    desk.brain.tell_state(desk.now_s)
    desk.ask(1, t="order", name=stop, seen=seen)
    assert [order.name for order in desk.orders] == [stop]
    assert desk.brain.refused == 0


@pytest.mark.parametrize("name", sorted(set(get_args(CommandName)) - STOPS))
def test_whatever_moves_the_aircraft_is_refused_from_a_page_that_shows_an_old_state(name: str) -> None:
    desk = Desk(view_stale_s=3.0)
    desk.join(1, "Anna")
    desk.now_s += 60.0
    which = {"tree_id": 3} if name == "choose" else {}
    assert "stale" in desk.ask(1, t="order", name=name, seen=1, **which)["reason"]
    assert not desk.orders


def test_a_repeated_request_an_unknown_aircraft_and_a_misplaced_tree_are_refused() -> None:
    desk = Desk()
    desk.join(1, "Anna")
    desk.order(1, "start")
    again = parse(json.dumps({"t": "order", "id": 1, "uav": "uav1", "name": "start", "seen": 1}))
    desk.brain.on_request(1, again, desk.now_s)
    assert len(desk.orders) == 1
    assert "repeated" in desk.pages.last("reply", 1)["reason"]
    desk.orders.clear()
    assert "no aircraft uav9" in desk.order(1, "start", uav="uav9")["reason"]
    assert "choose takes" in desk.order(1, "choose")["reason"]
    assert "choose takes" in desk.order(1, "land", tree_id=3)["reason"]
    assert not desk.orders
    assert desk.brain.refused == 4


def test_a_page_that_said_nothing_of_itself_may_not_order() -> None:
    desk = Desk()
    desk.brain.on_open(5, "10.0.0.9")
    desk.brain.on_request(5, Order(t="order", id=1, uav="uav1", name="start", seen=0), desk.now_s)
    assert not desk.orders
    assert any("10.0.0.9" in line and "refused" in line for line in desk.log())


def test_a_page_is_told_everything_when_it_opens() -> None:
    desk = Desk()
    a = desk.brain.aircraft("uav1")
    a.on_trees(TreeList(stamp_ns=1, map_id="m1", version=1, graph_version=0, trees=(tree(1, 4.0, 1.0),)))
    a.on_pose(pose(0.0))
    a.on_pose(pose(1.0))
    desk.join(1, "Anna")
    kinds = [message["t"] for page, message in desk.pages.told if page == 1]
    assert kinds[:2] == ["welcome", "events"]
    assert {"trees", "trail", "state"} <= set(kinds)
    assert desk.pages.last("trees", 1)["rows"][0][:4] == [1, 4.0, 1.0, -0.1]
    assert len(desk.pages.last("trail", 1)["points"]) == 2


def test_unchanged_trees_are_not_told_again() -> None:
    desk = Desk()
    desk.join(1, "Anna")
    listed = TreeList(stamp_ns=1, map_id="m1", version=1, graph_version=0, trees=(tree(1, 4.0, 1.0),))
    for version in (1, 2, 3):
        desk.brain.aircraft("uav1").on_trees(listed.model_copy(update={"version": version, "stamp_ns": version}))
        desk.brain.tell_trees()
    assert sum(m["t"] == "trees" and p == 0 for p, m in desk.pages.told) == 1


# -- ages


def test_late_is_late_and_lost_is_lost() -> None:
    links = LinkAges()
    assert links.link(0.0) == "none"
    for step in range(20):
        links.note(SLAM_POSE, "slam/pose", step * 0.1, step)
        links.note(MISSION_STATE, "mission/state", step * 0.1, step)
    assert links.link(1.95) == "good"
    assert links.arrivals["slam/pose"].rate_hz(1.9) == pytest.approx(10.0, rel=0.2)
    assert links.arrivals["slam/pose"].level(2.5) == "late"
    assert links.link(2.5) == "late"
    assert links.link(3.5) == "lost"
    links.note(TREES_LIST, "trees/list", 3.5, None)  # the detector may run on the ground: no sign of the aircraft
    assert links.link(3.5) == "lost"
    links.note(VEHICLE_STATE, "vehicle/state", 3.6, 1)
    assert links.link(3.6) == "late"


def test_a_stamp_in_the_future_makes_nothing_young() -> None:
    desk = Desk()
    a = desk.brain.aircraft("uav1")
    a.on_mission(mission(stamp_ns=2**62))
    a.links.note(MISSION_STATE, "mission/state", 10.0, 1)
    assert a.links.age_s("mission/state", 15.0) == 5.0


def test_events_follow_from_what_changes() -> None:
    desk = Desk()
    a = desk.brain.aircraft("uav1")
    a.on_mission(mission("idle"))
    a.on_mission(mission("scan", 5))
    a.on_mission(mission("scan", 5))
    a.on_mission(mission("scan", 5, failsafe="pose"))
    a.on_live("slam", alive=True)
    a.on_live("slam", alive=False)
    health = Health(
        service="slam", stamp_ns=1, seq=1, state="ready", pid=1, uptime_s=1.0, counters={}, rates_hz={}, work_ms={}
    )
    a.on_health(health)
    a.on_health(health.model_copy(update={"state": "degraded", "note": "no depth"}))
    a.links.note(SLAM_POSE, "slam/pose", 0.0, 1)
    a.check_link(0.1)
    a.check_link(9.0)
    a.links.note(SLAM_POSE, "slam/pose", 9.0, 2)
    a.check_link(9.1)
    assert desk.log()[1:] == ["idle: because", "scan: because", "failsafe pose: because", "slam is there", "slam is gone",
                              "slam: no depth", "link lost: nothing heard, what is shown is old", "link is back"]  # fmt: skip


def test_an_older_list_and_an_older_map_do_not_come_back() -> None:
    a = Desk().brain.aircraft("uav1")
    new = TreeList(stamp_ns=9, map_id="m1", version=9, graph_version=0, trees=(tree(1, 4.0, 1.0),))
    assert a.on_trees(new)
    assert not a.on_trees(new.model_copy(update={"stamp_ns": 3, "version": 3}))
    a.on_pose(pose(1.0))
    a.on_pose(pose(2.0, "m2"))
    assert [point[0] for point in a.trail] == [2.0]


def test_a_trail_keeps_the_newest_points_in_order() -> None:
    trail = Trail(most=3)
    assert trail.newest is None
    for x in range(5):
        trail.append((float(x), 0.5, -0.25, 1.5))
        assert trail.newest == (x, 0.5, -0.25, 1.5)
    assert list(trail) == [(x, 0.5, -0.25, 1.5) for x in (2.0, 3.0, 4.0)]
    assert len(trail) == 3
    trail.clear()
    assert list(trail) == []


# -- what comes from browsers


@given(st.text(max_size=200))
def test_random_text_is_refused_and_never_more(text: str) -> None:
    with pytest.raises(DecodeError):
        parse(text)


@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=9), lambda c: st.lists(c) | st.dictionaries(st.text(max_size=6), c)))  # fmt: skip
def test_random_values_in_an_order_are_refused_or_an_order(value: Any) -> None:
    body = {"t": "order", "id": 1, "uav": value, "name": "hold", "seen": 1}
    try:
        request = parse(json.dumps(body))
    except DecodeError:
        return
    assert isinstance(request, Order)
    assert isinstance(value, str)


@pytest.mark.parametrize("text", [
    '{"t":"order","id":1,"uav":"uav1","name":"fly","seen":1}', '{"t":"order","id":-1,"uav":"uav1","name":"start","seen":1}',
    '{"t":"order","id":1,"uav":"../x","name":"start","seen":1}', '{"t":"order","id":"1","uav":"uav1","name":"start","seen":1}',
    '{"t":"order","id":1,"uav":"uav1","name":"start","seen":1,"force":true}', '{"t":"hello","secret":"short","name":"x"}',
    '{"t":"hello","secret":"aaaaaaaaaaaaaaaaaaaaaaaa","name":"a\\nb"}', "[" * 3000, " " * (MAX_BYTES + 1), '{"id":NaN}',
])  # fmt: skip
def test_forged_requests_are_refused(text: str) -> None:
    with pytest.raises(DecodeError):
        parse(text)


# -- the outbox and the preview


def test_newer_state_replaces_older_and_order_is_kept_for_the_rest() -> None:
    box = Outbox()
    box.put_latest("state", "old")
    box.put("event 1")
    box.put_latest("state", "new")
    box.put("event 2")
    assert [box.take() for _ in range(4)] == ["event 1", "event 2", "new", None]
    assert box.replaced == 1


def test_a_browser_that_takes_nothing_is_cut_off_and_holds_little() -> None:
    box = Outbox()
    for number in range(100_000):
        box.put(f"event {number}")
        box.put_latest("state", "x" * 1000)
    assert box.overflowed
    assert len(box._queue) <= 1024
    assert len(box._latest) == 1


def test_a_preview_names_its_aircraft() -> None:
    assert frame_of("uav1", b"jpeg") == b"P\x04uav1jpeg"


def test_pages_are_told_of_fusion_and_the_log_of_who_carries_the_pose() -> None:
    desk = Desk()
    desk.join(1, "Anna")
    craft = desk.brain.aircraft("uav1")
    desk.brain.tell_state(desk.now_s)
    assert desk.pages.last("state")["aircraft"][0]["fusion"] is None, "off: nothing is heard of it"
    place = EarthPlace(latitude_deg=48.1, longitude_deg=11.5, altitude_m=520.0, heading_rad=0.1, sigma_m=0.42)
    craft.on_fusion(fused(place=place))
    craft.on_fusion(fused(seq=2, carrier="imu", carried_s=0.6, gps="distrusted", gps_word="it jumped by 10 m"))
    desk.brain.tell_state(desk.now_s)
    told = desk.pages.last("state")["aircraft"][0]["fusion"]
    assert (told["carrier"], told["carried"], told["gps"], told["gps_word"]) == (
        "imu",
        0.6,
        "distrusted",
        "it jumped by 10 m",
    )
    assert told["place"] is None
    words = [(e.level, e.text) for e in desk.brain.log.latest()]
    assert words[-3:] == [
        ("good", "fusion: the camera gives the pose"), ("warn", "fusion: the IMU carries the pose"), ("warn", "GPS distrusted: it jumped by 10 m"),
    ]  # fmt: skip
