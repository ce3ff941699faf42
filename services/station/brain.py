"""The station's decisions: who is there, which order goes out, what each page is told. Pure: no bus, no web, no clock.

One thread calls it. Orders leave through ``send_order`` and their answers come back through ``on_answer``; pages are
reached through ``Pages``. Every order ends in the log, whether it was accepted, refused here, refused by the aircraft
or never answered.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from schemas.command import CommandReply
from schemas.orders import STOPS, CommandName
from services.station.aircraft import Aircraft
from services.station.config import StationConfig
from services.station.events import Event, EventLevel, EventLog
from services.station.operators import Operator, OperatorDesk
from services.station.requests import Cloud, HandOver, Hello, Order, Release, Request, Take
from services.station.view import aircraft_view, operators_view, trail_view, trees_view

_STATES_KNOWN = 600


class Pages(Protocol):
    """The open pages, by number."""

    def latest(self, key: str, text: str) -> None:
        """Give every page ``text``; an earlier one of the same key that still waits is replaced."""
        ...

    def each(self, text: str) -> None:
        """Give every page ``text``, in order, none left out."""
        ...

    def one(self, page: int, text: str) -> None:
        """Give one page ``text``, in order."""
        ...


@dataclass(slots=True)
class Session:
    """One open page."""

    address: str
    operator: Operator | None = None
    last_id: int = -1
    cloud_of: str = ""


@dataclass(frozen=True, slots=True)
class Outgoing:
    """An order on its way to an aircraft."""

    uav: str
    name: CommandName
    tree_id: int | None
    sender: str
    page: int
    id: int
    who: str


class Brain:
    """All that the station knows and decides."""

    def __init__(
        self, config: StationConfig, pages: Pages, send_order: Callable[[Outgoing], None], wall_ns: Callable[[], int]
    ) -> None:
        self.config = config
        self.desk = OperatorDesk(config.keep_command_s)
        self.log = EventLog(wall_ns)
        self.fleet: dict[str, Aircraft] = {}
        self.sessions: dict[int, Session] = {}
        self.refused = 0
        self.on_cloud_wish: Callable[[str], None] = lambda _: None
        """Told when a page begins to look at an aircraft's cloud."""
        self.fleet_view: Callable[[], dict[str, Any] | None] = lambda: None
        """Who holds which tree; None where this station is no arbiter."""
        self._pages = pages
        self._send_order = send_order
        self._state = 0
        self._sent: deque[tuple[int, float]] = deque(maxlen=_STATES_KNOWN)
        self._trees_sent: dict[str, int] = {}
        self.log.listeners.append(self._on_event)

    def aircraft(self, uav: str) -> Aircraft:
        """Return an aircraft, known or new."""
        known = self.fleet.get(uav)
        if known is None:
            known = self.fleet[uav] = Aircraft(uav, self.log)
            self.fleet = dict(sorted(self.fleet.items()))
            self.log.add(uav, "link", "info", f"{uav} is heard")
        return known

    # -- to the pages

    def tell_state(self, now_s: float) -> None:
        """Give the pages the present state; called at ``page_hz``."""
        for uav, operator in self.desk.expire(now_s):
            self.log.add(uav, "operator", "warn", f"{operator.name} is gone: nobody is in command", operator.name)
        for aircraft in self.fleet.values():
            aircraft.check_link(now_s)
        self._state += 1
        self._sent.append((self._state, now_s))
        if self.sessions:
            self._pages.latest("state", self._state_text(now_s))

    def _state_text(self, now_s: float) -> str:
        return _json({
            "t": "state", "n": self._state, "hz": self.config.page_hz,
            "aircraft": [aircraft_view(a, self.desk, now_s) for a in self.fleet.values()],
            "operators": operators_view(self.desk), "fleet": self.fleet_view(),
        })  # fmt: skip

    def tell_trees(self) -> None:
        """Give the pages the lists of trees that changed; called once a second."""
        for uav, aircraft in self.fleet.items():
            if self._trees_sent.get(uav) == aircraft.trees_version:
                continue
            self._trees_sent[uav] = aircraft.trees_version
            if self.sessions:
                self._pages.latest(f"trees/{uav}", _json({"t": "trees", **trees_view(aircraft)}))

    def _on_event(self, event: Event) -> None:
        if self.sessions:
            self._pages.each(_json({"t": "events", "items": [event.as_dict()]}))

    def _welcome(self, page: int, operator: Operator, now_s: float) -> None:
        self._pages.one(page, _json({"t": "welcome", "you": {"n": operator.number, "name": operator.name},
                                     "cloud": self.config.cloud, "inventory": self.config.inventory.database != "none",
                                     "stale_s": self.config.view_stale_s}))  # fmt: skip
        self._pages.one(page, _json({"t": "events", "items": [e.as_dict() for e in self.log.latest()], "all": True}))
        for aircraft in self.fleet.values():
            self._pages.one(page, _json({"t": "trees", **trees_view(aircraft)}))
            self._pages.one(page, _json({"t": "trail", **trail_view(aircraft)}))
        self._state += 1
        self._sent.append((self._state, now_s))
        self._pages.one(page, self._state_text(now_s))

    # -- from the pages

    def on_open(self, page: int, address: str) -> None:
        """Take note of a page that was opened."""
        self.sessions[page] = Session(address)

    def on_close(self, page: int, now_s: float) -> None:
        """Take note of a page that was closed."""
        session = self.sessions.pop(page, None)
        if session is not None and session.operator is not None:
            self.desk.leave(session.operator, now_s)
            if not session.operator.browsers:
                self.log.add("", "operator", "info", f"{session.operator.name} has left", session.operator.name)

    def on_request(self, page: int, request: Request, now_s: float) -> None:
        """Do what a page asks for, or say why not."""
        session = self.sessions.get(page)
        if session is None:
            return
        if isinstance(request, Hello):
            self._hello(page, session, request, now_s)
            return
        if session.operator is None:
            self.refuse(page, "said nothing of who asks")
            return
        if request.id <= session.last_id:
            self._reply(page, request.id, accepted=False, reason="repeated: this request was made before")
            self._count_refused("", session.operator, f"a repeated request was refused (from {session.address})")
            return
        session.last_id = request.id
        if isinstance(request, Cloud):
            self._wish_cloud(page, session, request)
        elif request.uav not in self.fleet:
            self._answer(page, request.id, "", session.operator, f"no aircraft {request.uav} is known", accepted=False)
        elif isinstance(request, Order):
            self._order(page, session.operator, request, now_s)
        else:
            self._change_command(page, session.operator, request)

    def _wish_cloud(self, page: int, session: Session, request: Cloud) -> None:
        if not self.config.cloud:
            self._reply(
                page,
                request.id,
                accepted=False,
                reason="the cloud is not served: this station was started with --no-cloud",
            )
            return
        session.cloud_of = request.uav if request.on and request.uav in self.fleet else ""
        self._reply(page, request.id, accepted=True, reason="")
        if session.cloud_of:
            self.on_cloud_wish(session.cloud_of)

    def cloud_watchers(self, uav: str) -> list[int]:
        """Return the pages that look at an aircraft's cloud."""
        return [page for page, session in self.sessions.items() if session.cloud_of == uav]

    def refuse(self, page: int, why: str) -> None:
        """Log what a page sent and should not have."""
        session = self.sessions.get(page)
        if session is not None:
            who = session.operator
            self._count_refused("", who, f"a forged or broken request was refused (from {session.address}): {why}")

    def _hello(self, page: int, session: Session, hello: Hello, now_s: float) -> None:
        if session.operator is None:
            session.operator = self.desk.join(hello.secret, hello.name.strip() or "operator")
            if session.operator.browsers == 1:
                text = f"{session.operator.name} is here (from {session.address})"
                self.log.add("", "operator", "info", text, session.operator.name)
            self._welcome(page, session.operator, now_s)
        elif session.operator.name != hello.name:
            self.log.add("", "operator", "info", f"{session.operator.name} is now called {hello.name}", hello.name)
            session.operator.name = hello.name

    def _order(self, page: int, operator: Operator, order: Order, now_s: float) -> None:
        what = order.name if order.tree_id is None else f"{order.name} {order.tree_id}"
        shown_s = next((at for n, at in reversed(self._sent) if n == order.seen), None)
        refusal = self.desk.refusal(operator, order.uav, order.name)
        if (order.name == "choose") != (order.tree_id is not None):
            refusal = "choose takes the id of a tree, no other order does"
        elif order.name not in STOPS and (shown_s is None or now_s - shown_s > self.config.view_stale_s):
            old = "unknown" if shown_s is None else f"{now_s - shown_s:.1f} s old"
            refusal = f"stale: the page showed a state that is {old}; look again"
        if refusal:
            self._answer(page, order.id, order.uav, operator, refusal, accepted=False, what=what)
            return
        if self.desk.commander(order.uav) is None and order.name != "hold":
            self.desk.take(operator, order.uav)
            self.log.add(order.uav, "operator", "info", f"{operator.name} takes command", operator.name)
        self._send_order(
            Outgoing(order.uav, order.name, order.tree_id, operator.sender, page, order.id, operator.name)
        )  # fmt: skip

    def on_answer(self, sent: Outgoing, reply: CommandReply | None) -> None:
        """Take an aircraft's answer to an order, None when it did not answer."""
        what = sent.name if sent.tree_id is None else f"{sent.name} {sent.tree_id}"
        accepted = reply is not None and reply.accepted
        reason = f"no answer from {sent.uav}: the order may or may not have arrived" if reply is None else reply.reason
        self._reply(sent.page, sent.id, accepted=accepted, reason=reason)
        level: EventLevel = "good" if accepted else "bad"
        word = "accepted" if accepted else "refused" if reply is not None else "unanswered"
        self.log.add(sent.uav, "command", level, f"{sent.who}: {what}: {word}: {reason}", sent.who)

    def _change_command(self, page: int, operator: Operator, request: Take | Release | HandOver) -> None:
        uav, reason, accepted = request.uav, "", True
        if isinstance(request, Take):
            before = self.desk.take(operator, uav)
            reason = f"{operator.name} takes command" + (f" from {before.name}" if before else "")
        elif isinstance(request, Release):
            accepted = self.desk.release(operator, uav)
            reason = f"{operator.name} gives command back" if accepted else "you are not in command"
        else:
            to = self.desk.hand_over(operator, uav, request.to)
            accepted = to is not None
            reason = f"{operator.name} hands command to {to.name}" if to else "not in command, or nobody of that number"
        if accepted:
            self.log.add(uav, "operator", "warn", reason, operator.name)
            self._reply(page, request.id, accepted=True, reason=reason)
        else:
            self._answer(page, request.id, uav, operator, reason, accepted=False, what="command")

    def _answer(
        self, page: int, number: int, uav: str, operator: Operator, reason: str, *, accepted: bool, what: str = "order"
    ) -> None:
        self._reply(page, number, accepted=accepted, reason=reason)
        self._count_refused(uav, operator, f"{operator.name}: {what}: refused by the station: {reason}")

    def _count_refused(self, uav: str, operator: Operator | None, text: str) -> None:
        self.refused += 1
        self.log.add(uav, "command", "bad", text, operator.name if operator else "")

    def _reply(self, page: int, number: int, *, accepted: bool, reason: str) -> None:
        self._pages.one(page, _json({"t": "reply", "id": number, "accepted": accepted, "reason": reason}))


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
