"""The encrypted bus: each identity can do exactly what the topics table says, and strangers nothing."""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
import zenoh

from schemas.topics import ANY, TOPICS, Delivery, Topic
from services.common.bus import Bus
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.common.errors import InputError
from services.common.session import free_port, opened, opened_node, router_config
from services.common.stop import StopSignal
from services.router.service import run as run_router
from services.security.access import may_publish, may_subscribe
from services.security.authority import Authority
from services.security.config import SecurityConfig
from services.security.identity import ROLES, Identity
from services.security.transport import router_settings
from tests.process.nodes import tree_list

STATION = "station.alice"
NODES = (*(f"uav1.{role}" for role in ROLES if role not in {"station", "router"}), STATION)
SETTLE_S = 1.0


def now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certs")
    authority = Authority.create(folder, now())
    for name in ("uav1.router", *NODES, "uav2.slam", "station.eve"):
        authority = authority.issue(Identity.parse(name), now(), hosts=("127.0.0.1",))
    authority.revoke(Identity.parse("station.eve"))
    return folder


def configured(folder: Path, port: int, identity: str = "") -> TreedockConfig:
    return TreedockConfig.model_validate({
        "router": {"protocol": "tls", "port": port}, "security": {"folder": folder, "identity": identity},
    })  # fmt: skip


@pytest.fixture(scope="module")
def port(folder: Path) -> Iterator[int]:
    port = free_port()
    secured = router_settings(SecurityConfig(folder=folder), "uav1")
    with opened(router_config(f"tls/127.0.0.1:{port}", secured)):
        yield port


@contextlib.contextmanager
def node(folder: Path, port: int, identity: str) -> Iterator[zenoh.Session]:
    with opened_node(configured(folder, port, identity), None, lambda: False, wait_s=5.0) as session:
        yield session


def test_every_identity_does_exactly_what_the_table_says(folder: Path, port: int) -> None:
    """All nodes at once: each puts its name on every key, declared before and undeclared, and listens to every key."""
    streams = [t for t in TOPICS if t.delivery is not Delivery.QUERY]
    heard: set[tuple[str, str, str]] = set()
    with contextlib.ExitStack() as stack:
        sessions = {name: stack.enter_context(node(folder, port, name)) for name in NODES}
        for name, session in sessions.items():
            for topic in streams:
                key = topic.key("*" if name == STATION else "uav1")

                def take(sample: zenoh.Sample, name: str = name) -> None:
                    heard.add((name, str(sample.key_expr), sample.payload.to_string()))

                session.declare_subscriber(key, take)
        keys = {name: [key for topic in streams for key in keys_of(name, topic)] for name in NODES}
        # what services send by: a declared publisher is silent until it has been told of a subscriber
        declared = [(name, sessions[name].declare_publisher(key)) for name in NODES for key in keys[name]]
        time.sleep(SETTLE_S)
        for name, session in sessions.items():
            for key in keys[name]:
                session.put(key, f"{name} put")
        for name, publisher in declared:
            publisher.put(f"{name} declared")
        time.sleep(SETTLE_S)
    assert heard == {(n, key, f"{speaker} {how}") for n, key, speaker in expected() for how in ("put", "declared")}


def keys_of(name: str, topic: Topic) -> list[str]:
    """A node's own key of a topic; where each service has a leaf, another service's too."""
    if not topic.name.endswith("*"):
        return [topic.key("uav1")]
    return sorted({topic.key("uav1", leaf) for leaf in (Identity.parse(name).role, "slam")})


def expected() -> set[tuple[str, str, str]]:
    found = set()
    for speaker in NODES:
        for topic in TOPICS:
            role = Identity.parse(speaker).role
            if not may_publish(role, topic):
                continue
            key = topic.key("uav1", role if topic.name.endswith("*") else None)
            for listener in NODES:
                # what a session puts reaches its own subscribers without the router: the access control is passed by
                if listener == speaker or may_subscribe(Identity.parse(listener).role, topic):
                    found.add((listener, key, speaker))
    own = {
        (name, topic.key("uav1", leaf), name)
        for name in NODES
        for topic in TOPICS
        if topic.delivery is not Delivery.QUERY
        for leaf in ({Identity.parse(name).role, "slam"} if topic.name.endswith("*") else {None})
    }
    return found | own


def asked_of(topic: Topic) -> tuple[set[str], set[str]]:
    """Who may ask a key, and who may answer: orders by the table's own columns, and kept state of what may be heard."""
    roles = {name: Identity.parse(name).role for name in NODES}
    if topic.delivery is Delivery.QUERY:
        asks = {name for name, role in roles.items() if topic.producer in {role, ANY}}
        return asks, {name for name, role in roles.items() if role in topic.consumers}
    asks = {name for name, role in roles.items() if may_subscribe(role, topic)}
    return asks, {name for name, role in roles.items() if may_publish(role, topic)}


def test_every_identity_asks_and_answers_exactly_what_the_table_says(folder: Path, port: int) -> None:
    """Orders, nonces, the time and all state that is kept: everybody offers answers to every key, and asks for every key."""
    keys = {t.key("uav1", "hold" if t.name.endswith("*") else None): t
            for t in TOPICS if t.delivery is Delivery.QUERY or t.rate_hz == 0}  # fmt: skip
    answers: dict[tuple[str, str], set[str]] = {}
    with contextlib.ExitStack() as stack:
        sessions = {name: stack.enter_context(node(folder, port, name)) for name in NODES}
        for name, session in sessions.items():

            def answer(query: zenoh.Query, name: str = name) -> None:
                with query:
                    query.reply(query.key_expr, name)

            for key in keys:
                session.declare_queryable(key, answer)
        time.sleep(SETTLE_S)
        for name, session in sessions.items():  # a node's questions at once, and then what came of them
            coming = {key: session.get(key, timeout=10.0, target=zenoh.QueryTarget.ALL,
                                       consolidation=zenoh.ConsolidationMode.NONE) for key in keys}  # fmt: skip
            for key, replies in coming.items():
                answers[name, key] = {r.ok.payload.to_string() for r in replies if r.ok is not None} - {name}
    for key, topic in keys.items():
        asks, gives = asked_of(topic)
        for name in NODES:
            assert answers[name, key] == (gives - {name} if name in asks else set()), f"{name} asks {key}"


def test_an_advanced_topic_reaches_a_late_joiner_and_tokens_are_seen(folder: Path, port: int) -> None:
    from schemas.topics import TREES_LIST

    with contextlib.ExitStack() as stack:
        detector = Bus(stack.enter_context(node(folder, port, "uav1.detector")), "uav1", HealthBook())
        detector.declare_live("detector")
        detector.publish(TREES_LIST, tree_list(3))
        time.sleep(0.3)
        late = Bus(stack.enter_context(node(folder, port, STATION)), "uav1", HealthBook())
        got: list[object] = []
        late.subscribe(TREES_LIST, got.append)
        deadline = time.monotonic() + 5.0
        while not got and time.monotonic() < deadline:
            late.inbox.wait(0.1)
            if (taken := late.inbox.take()) is not None:
                taken[0].handler(taken[1])
        assert got == [tree_list(3)]
        assert late.live_services() == ["detector"]


def refused(config: Mapping[str, object], endpoint: str) -> bool:
    values = {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False,
              "connect/timeout_ms": 1500, **config}  # fmt: skip
    made = zenoh.Config()
    for key, value in values.items():
        made.insert_json5(key, json.dumps(value))
    try:
        with opened(made) as session:
            return not list(session.info.routers_zid())
    except zenoh.ZError:
        return True


TLS = "transport/link/tls"


def test_strangers_are_refused(folder: Path, port: int, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{port}"
    ca = {f"{TLS}/root_ca_certificate": str(folder / "ca.pem")}

    def pair(at: Path, name: str) -> dict[str, object]:
        return {f"{TLS}/enable_mtls": True, f"{TLS}/connect_certificate": str(at / f"{name}.pem"),
                f"{TLS}/connect_private_key": str(at / f"{name}.key")}  # fmt: skip

    slam = Identity.parse("uav1.slam")
    other = Authority.create(tmp_path / "other", now()).issue(slam, now())
    old = Authority.open(folder)
    expired_at = tmp_path / "expired"
    expired = Authority(expired_at, old.certificate, old.key, old.register)
    expired_at.mkdir()
    expired.issue(slam, now() - dt.timedelta(days=10), days=1)

    assert not refused({**ca, **pair(folder, "uav1.slam")}, endpoint), "the right certificate is let in"
    assert refused(ca, endpoint), "no certificate"
    assert refused({**ca, **pair(other.folder, "uav1.slam")}, endpoint), "another authority's"
    assert refused({**ca, **pair(expired_at, "uav1.slam")}, endpoint), "expired"
    assert refused({}, f"tcp/127.0.0.1:{port}"), "plain TCP"


def test_a_router_of_another_authority_is_not_trusted(port: int, tmp_path: Path) -> None:
    slam = Identity.parse("uav1.slam")
    other = Authority.create(tmp_path, now()).issue(slam, now())
    assert (other.folder / "uav1.slam.key").exists()
    with pytest.raises(InputError, match="refused"), node(other.folder, port, "uav1.slam"):
        pass


@pytest.mark.parametrize("stranger", ["station.eve", "uav2.slam"])
def test_a_revoked_certificate_and_another_aircrafts_have_no_rights(folder: Path, port: int, stranger: str) -> None:
    heard: list[str] = []
    with (
        node(folder, port, STATION) as good,
        node(folder, port, stranger) as bad,
        node(folder, port, "uav1.slam") as slam,
    ):
        good.declare_subscriber("treedock/v1/*/slam/pose", lambda s: heard.append(f"good {s.payload.to_string()}"))
        bad.declare_subscriber("treedock/v1/uav1/slam/pose", lambda s: heard.append(f"bad {s.payload.to_string()}"))
        time.sleep(0.5)
        bad.put("treedock/v1/uav1/slam/graph", "forged")
        slam.put("treedock/v1/uav1/slam/pose", "true")
        replies = list(bad.get("treedock/v1/uav1/cmd/start", timeout=0.5))
        time.sleep(0.5)
    assert heard == ["good true"]
    assert not [r for r in replies if r.ok is not None]


def test_a_router_that_gets_another_list_ends_and_comes_back_without_the_revoked(tmp_path: Path) -> None:
    """End to end: ``certs revoke``, the new list copied to the router's machine, and nothing else done by hand."""
    fleet, aboard = tmp_path / "fleet", tmp_path / "aboard"
    authority = Authority.create(fleet, now())
    for name in ("uav1.router", "uav1.navigator", "station.eve", "station.alice"):
        authority = authority.issue(Identity.parse(name), now(), hosts=("127.0.0.1",))
    authority.export([Identity.parse("uav1.router"), Identity.parse("uav1.navigator")], aboard)
    config = configured(aboard, free_port())

    def answered(station: str, within_s: float = 10.0) -> bool:
        with node(fleet, config.router.port, station) as session:
            end = time.monotonic() + within_s
            while time.monotonic() < end:
                replies = session.get("treedock/v1/uav1/cmd/hold", timeout=0.5)
                if any(r.ok is not None for r in replies):
                    return True
            return False

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, "heard")

    ended: list[int] = []
    with supervised(config, ended), node(aboard, config.router.port, "uav1.navigator") as navigator:
        navigator.declare_queryable("treedock/v1/uav1/cmd/hold", answer)
        assert answered("station.eve")
        (aboard / "identities.json").write_text("{")
        time.sleep(1.5)
        assert not ended, "a damaged list leaves the rights in force"
        authority.revoke(Identity.parse("station.eve")).export([], aboard)
        end = time.monotonic() + 20.0
        while not ended and time.monotonic() < end:
            time.sleep(0.05)
        assert ended == [0]
        assert answered("station.alice"), "the aircraft is reached again"
        assert not answered("station.eve", within_s=2.0)


@contextlib.contextmanager
def supervised(config: TreedockConfig, ended: list[int]) -> Iterator[None]:
    """Run the router on a thread, started again whenever it ends, as a supervisor does."""
    over, stops = threading.Event(), [StopSignal()]

    def keep() -> None:
        while not over.is_set():
            code = run_router(config, stops[-1])
            if not over.is_set():
                stops.append(StopSignal())
                ended.append(code)

    thread = threading.Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        stops[-1].set()
        thread.join(10.0)
