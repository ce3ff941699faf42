"""The bus over Zenoh: publish, subscribe, answer and ask, each with the quality that the topics table names.

Nothing ever blocks: what the network cannot take is dropped (``CongestionControl.DROP``), what a slow consumer
cannot take is dropped too, and both are counted. Received bytes are never trusted: another encoding, too many bytes
or an undecodable message is counted, told once a second, and otherwise ignored.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh
from zenoh import ext

from schemas.codec import Wire, decode, encode
from schemas.envelope import DecodeError
from schemas.topics import PREFIX, Delivery, Topic
from services.common.context import HealthBook
from services.common.inbox import Inbox, Mailbox
from services.common.logging import Throttle

LOG = logging.getLogger(__name__)

M = TypeVar("M", bound=Wire)
Q = TypeVar("Q", bound=Wire)
A = TypeVar("A", bound=Wire)
_Publisher = zenoh.Publisher | ext.AdvancedPublisher

_PRIORITIES = {
    "real_time": zenoh.Priority.REAL_TIME,
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
    "background": zenoh.Priority.BACKGROUND,
}
_DROP = zenoh.CongestionControl.DROP
_STREAM_RING = 16
_ON_CHANGE_RING = 256
"""Of topics without a rate: keyframes and submaps come in bursts, and none should be lost while a consumer works."""
_QUERY_RING = 64
_HEARTBEAT_S = 0.5
_TIMED_OUT = "Timeout"
"""Zenoh's own reply to a query whose time is up."""


class Bus:
    """One service's connection. Samples wait in ``inbox`` until the work loop takes them and calls ``deliver``."""

    def __init__(self, session: zenoh.Session, uav: str, health: HealthBook, inbox: Inbox | None = None) -> None:
        self.session = session
        self.uav = uav
        self.health = health
        self.inbox = inbox or Inbox()
        self.passed: Counter[str] = Counter()
        """Samples sent and received per topic name since the start."""
        self.last_received_s: dict[str, float] = {}
        """Monotonic time of the last sample per subscribed topic name."""
        self._publishers: dict[str, _Publisher] = {}
        self._kept: list[object] = []
        self._subscribers: dict[str, list[Any]] = {}
        self._last_seq: dict[str, int] = {}
        self._throttle = Throttle()
        self._boxes: dict[str, Mailbox] = {}
        self._live: set[str] | None = None

    # -- sending

    def publish(self, topic: Topic, message: Wire, leaf: str | None = None) -> None:
        """Send a message; it is dropped where the network cannot take it."""
        key = topic.key(self.uav, leaf)
        payload = encode(message)
        if len(payload) > topic.max_bytes:
            # the fault of a core that grew beyond its contract: every receiver would refuse it
            self._fault(
                topic.name, f"a message of {len(payload)} bytes is not sent, at most {topic.max_bytes} are accepted"
            )
            return
        self._publisher(topic, key).put(payload)
        self.passed[topic.name] += 1

    def listened(self, topic: Topic, leaf: str | None = None) -> bool:
        """Whether anybody subscribes to the topic at this moment."""
        publisher = self._publisher(topic, topic.key(self.uav, leaf))
        if not isinstance(publisher, zenoh.Publisher):
            return True  # an advanced publisher cannot tell, and keeps what it sends for those who come later
        status: object = publisher.matching_status  # annotated as bool in 1.10.2, but an object with a field
        return bool(getattr(status, "matching", status))

    def _publisher(self, topic: Topic, key: str) -> _Publisher:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._declare_publisher(topic, key)
        return publisher

    def _declare_publisher(self, topic: Topic, key: str) -> _Publisher:
        priority = _PRIORITIES[topic.priority]
        if topic.delivery is not Delivery.ADVANCED:
            return self.session.declare_publisher(
                key, encoding=topic.encoding, congestion_control=_DROP, priority=priority, express=topic.express
            )
        replies = ext.RepliesConfig(congestion_control=_DROP, priority=priority, express=False)
        return ext.declare_advanced_publisher(
            self.session, key, encoding=topic.encoding, congestion_control=_DROP, priority=priority, express=topic.express,
            cache=ext.CacheConfig(topic.cache, replies_config=replies),
            # a periodic heartbeat: the sporadic one is sent with BLOCK
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )  # fmt: skip

    # -- receiving

    def subscribe(
        self, topic: Topic, handler: Callable[[M], None], leaf: str | None = None, *, ring: int | None = None
    ) -> None:
        """Have the work loop call ``handler`` with each decoded sample; ``ring``: as many wait, not the table's."""
        self.subscribe_keys(topic, lambda _, message: handler(message), leaf, ring=ring)

    def subscribe_keys(
        self,
        topic: Topic,
        handler: Callable[[str, Any], None],
        leaf: str | None = None,
        *,
        at_once: bool = False,
        ring: int | None = None,
    ) -> None:
        """Subscribe with the key: ``handler(key, message)``; ``at_once`` calls it on Zenoh's thread (be quick)."""

        def deliver(sample: zenoh.Sample) -> None:
            message = self._receive(topic, sample)
            if message is not None:
                handler(str(sample.key_expr), message)

        if at_once:
            self._declare_subscriber(topic, topic.key(self.uav, leaf), deliver)
            return
        box = self.inbox.mailbox(deliver, ring or _ring(topic))
        self._boxes[topic.name] = box
        self._declare_subscriber(topic, topic.key(self.uav, leaf), lambda sample: self.inbox.put(box, sample))

    def _declare_subscriber(self, topic: Topic, key: str, callback: Callable[[Any], None]) -> None:
        direct = zenoh.handlers.Callback(callback, indirect=False)
        subscriber: object
        if topic.delivery is Delivery.ADVANCED:
            subscriber = ext.declare_advanced_subscriber(
                self.session, key, direct,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.cache),
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )  # fmt: skip
        else:
            subscriber = self.session.declare_subscriber(key, direct)
        self._subscribers.setdefault(topic.name, []).append(subscriber)

    def unsubscribe(self, topic: Topic) -> None:
        """End the subscriptions to a topic: for what is sent only while somebody listens."""
        for subscriber in self._subscribers.pop(topic.name, []):
            subscriber.undeclare()
        box = self._boxes.pop(topic.name, None)
        if box is not None:
            self.inbox.close(box)

    def _receive(self, topic: Topic, sample: zenoh.Sample) -> Wire | None:
        """Return the sample's message, or None after counting what is wrong with it."""
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        try:
            message = self._decode(topic.message, sample, topic.max_bytes)
        except DecodeError as error:
            self.health.count(f"decode_errors.{topic.name}")
            self._fault(topic.name, f"refused a sample on {sample.key_expr}: {error}")
            return None
        self.passed[topic.name] += 1
        self.last_received_s[topic.name] = time.monotonic()
        self._count_missed(topic, str(sample.key_expr), message)
        return message

    def _decode(self, kind: type[M], sample: zenoh.Sample | zenoh.Query, max_bytes: int) -> M:
        if sample.payload is None:
            raise DecodeError("no payload")
        encoding = str(sample.encoding)
        if encoding != kind.encoding():
            raise DecodeError(f"encoding {encoding[:100]!r}, expected {kind.encoding()!r}")
        if len(sample.payload) > max_bytes:
            raise DecodeError(f"{len(sample.payload)} bytes, at most {max_bytes} are accepted")
        return decode(kind, sample.payload.to_bytes())

    def _count_missed(self, topic: Topic, key: str, message: object) -> None:
        """Count gaps of the sequence number: dropped by the network or because we were busy."""
        seq = getattr(message, "seq", None)
        if not isinstance(seq, int):
            return
        last = self._last_seq.get(key)
        self._last_seq[key] = seq
        if last is not None and seq > last + 1:
            self.health.count(f"dropped.{topic.name}", seq - last - 1)

    def count_overflows(self) -> None:
        """Move the mailboxes' own losses to the health book, for topics whose messages carry no sequence number."""
        for name, box in self._boxes.items():
            lost, box.overflowed = box.overflowed, 0
            if lost and not any(key.endswith(name) for key in self._last_seq):
                self.health.count(f"dropped.{name}", lost)

    def _fault(self, about: str, text: str) -> None:
        self._throttle.log(LOG, logging.WARNING, about, text)

    # -- questions and answers

    def answer(self, topic: Topic, kind: type[Q], handler: Callable[[Q], Wire | None], leaf: str | None = None) -> None:
        """Answer queries that carry a ``kind``; undecodable ones get an error reply that says why."""

        def deliver(query: zenoh.Query) -> None:
            with query:
                request = self._request(topic, query, kind)
                reply = None if request is None else handler(request)
                if reply is not None:
                    self._reply(topic, query, reply, leaf)

        self._declare_queryable(topic.key(self.uav, leaf), deliver)

    def answer_state(
        self, topic: Topic, handler: Callable[[], list[Wire]], kind: type[Q] | None = None,
        chosen: Callable[[Q], list[Wire]] | None = None,
    ) -> None:  # fmt: skip
        """Answer payload-less queries with all messages that ``handler`` returns, those with a ``kind`` by ``chosen``."""

        def deliver(query: zenoh.Query) -> None:
            with query:
                if kind is None or chosen is None or query.payload is None:
                    messages = handler()
                elif (request := self._request(topic, query, kind)) is not None:
                    messages = chosen(request)
                else:
                    return
                for message in messages:
                    self._reply(topic, query, message, None)

        self._declare_queryable(topic.key(self.uav), deliver)

    def _request(self, topic: Topic, query: zenoh.Query, kind: type[Q]) -> Q | None:
        """Return what a query carries; None when it cannot be decoded: the asker is told why."""
        try:
            return self._decode(kind, query, topic.max_bytes)
        except DecodeError as error:
            self.health.count(f"decode_errors.{topic.name}")
            self._fault(topic.name, f"refused a query on {query.key_expr}: {error}")
            query.reply_err(str(error).encode(), encoding="text/plain")
            return None

    def _reply(self, topic: Topic, query: zenoh.Query, message: Wire, leaf: str | None) -> None:
        key = query.key_expr if leaf is None and topic.name.endswith("*") else topic.key(self.uav, leaf)
        query.reply(key, encode(message), encoding=message.encoding())

    def _declare_queryable(self, key: str, deliver: Callable[[Any], None]) -> None:
        box = self.inbox.mailbox(deliver, _QUERY_RING)
        direct: zenoh.handlers.Callback[zenoh.Query]
        direct = zenoh.handlers.Callback(lambda query: self.inbox.put(box, query), indirect=False)
        self._kept.append(self.session.declare_queryable(key, direct))

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None, *,
        quiet: bool = False,
    ) -> list[A]:  # fmt: skip
        """Query a key and return what decodes as ``kind`` within ``timeout_s``; never asked from a handler of itself.

        ``quiet``: that no answer came in time is nothing to warn of.
        """
        channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(4096)
        replies = self.session.get(
            topic.key(self.uav, leaf), channel, timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE, target=zenoh.QueryTarget.ALL, congestion_control=_DROP,
            priority=_PRIORITIES[topic.priority], express=topic.express,
            payload=None if request is None else encode(request), encoding=None if request is None else request.encoding(),
        )  # fmt: skip
        answers: list[A] = []
        for reply in replies:
            if reply.ok is None:
                words = bytes(reply.err.payload)[:200].decode(errors="replace") if reply.err else "nothing"
                if words == _TIMED_OUT:
                    level = logging.DEBUG if quiet else logging.WARNING
                    words = f"{topic.name} was not answered within {timeout_s:g} s: who answers it is too busy, or the link is"
                    self._throttle.log(LOG, level, topic.name, words)
                else:
                    self._fault(topic.name, f"{topic.name} answered: {words}")
                continue
            try:
                answers.append(self._decode(kind, reply.ok, getattr(kind, "MAX_BYTES", topic.max_bytes)))
            except DecodeError as error:
                self.health.count(f"decode_errors.{topic.name}")
                self._fault(topic.name, f"refused a reply on {topic.name}: {error}")
        return answers

    # -- liveness

    def declare_live(self, service: str) -> None:
        """Show the liveliness token ``live/{service}`` for as long as the session lives."""
        self._kept.append(self.session.liveliness().declare_token(f"{PREFIX}/{self.uav}/live/{service}"))

    def alive(self, service: str) -> bool:
        """Return whether a service's token stands; the first call begins to watch (and knows those already there)."""
        if self._live is None:
            self._live = set(self.live_services())
            watcher: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(self._on_token, indirect=False)
            key = f"{PREFIX}/{self.uav}/live/*"
            self._kept.append(self.session.liveliness().declare_subscriber(key, watcher, history=True))
        return service in self._live

    def _on_token(self, sample: zenoh.Sample) -> None:
        assert self._live is not None
        name = str(sample.key_expr).rsplit("/", 1)[-1]
        if sample.kind == zenoh.SampleKind.PUT:
            self._live.add(name)
        else:
            self._live.discard(name)

    def live_services(self, timeout_s: float = 0.5) -> list[str]:
        """Return the names of the services that are live now, sorted."""
        channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(256)
        replies = self.session.liveliness().get(f"{PREFIX}/{self.uav}/live/*", channel, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr).rsplit("/", 1)[-1] for reply in replies if reply.ok is not None})


def _ring(topic: Topic) -> int:
    if topic.delivery is Delivery.LATEST:
        return 1
    return _STREAM_RING if topic.rate_hz > 0 else _ON_CHANGE_RING
