"""The arbiter's book: who holds which tree, which trees are done. Pure: no bus, no file, no clock.

Safe by counting, not by agreement of clocks: the aircraft counts its lease from before it asked, the book from after
it granted, so the aircraft's view ends first whatever the link does (docs/decisions/fleet-claims.md).
A grant is remembered outside the process before it is told: after a restart every remembered lease counts anew for
its whole length, and a book without a memory grants nothing for one lease.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from schemas.fleet import ClaimReply, ClaimRequest, GoalKind, Vec2
from services.fleet.config import FleetConfig
from services.fleet.shapes import Stretch

_MOVED_M = 0.5
"""A renewed goal farther than this from the granted one (a corrected map) is judged anew."""
_MOST_LEASES_EACH = 4
_MOST_DONE = 100_000


@dataclass(frozen=True, slots=True)
class Lease:
    """What one aircraft holds."""

    uav: str
    lease_id: int
    kind: GoalKind
    way: Stretch
    radius_m: float
    lease_s: float
    tree_id: int | None = None
    until_ns: int = 0
    """On the arbiter's own clock; not remembered."""


@dataclass(frozen=True, slots=True)
class Done:
    """A tree that an aircraft has docked at."""

    uav: str
    at_m: Vec2
    sigma_m: float
    tree_id: int | None = None


@dataclass(frozen=True, slots=True)
class Memory:
    """What outlives the process."""

    leases: tuple[Lease, ...] = ()
    done: tuple[Done, ...] = ()


@dataclass
class Book:
    """Leases and visited trees. ``remember`` must have written for good when it returns; it raises OSError when it cannot."""

    rules: FleetConfig
    name: str
    """Of this arbiter, in every reply."""
    remember: Callable[[Memory], None]
    leases: dict[tuple[str, int], Lease] = field(default_factory=dict)
    done: list[Done] = field(default_factory=list)
    silent_until_ns: int = 0
    """A book without a memory grants nothing before."""

    def begin(self, memory: Memory | None, now_ns: int) -> None:
        """Take up what was remembered; None: nothing is known, not even that nothing was granted."""
        if memory is None:
            self.silent_until_ns = now_ns + _ns(self.rules.lease_s)
            return
        self.leases = {
            (lease.uav, lease.lease_id): replace(lease, until_ns=now_ns + _ns(lease.lease_s)) for lease in memory.leases
        }
        self.done = list(memory.done)

    def answer(self, uav: str, request: ClaimRequest, way: Stretch | str, now_ns: int) -> ClaimReply:
        """Judge a request; ``way`` is its goal in the shared frame, or why it cannot be placed there."""
        self._expire(now_ns)
        own = self.leases.get((uav, request.lease_id))
        if request.kind == "release":
            self.leases.pop((uav, request.lease_id), None)
            return self._reply(request, 0.0, "released")
        if isinstance(way, str):
            return self._reply(request, None, way)
        if request.kind == "done":
            return self._take_done(uav, request, way)
        if request.kind == "renew" and own is None:
            return self._reply(request, None, "this claim is not known here: it ran out, or was released", final=True)
        if own is not None:
            return self._renew(own, request, way, now_ns)
        if request.goal.kind == "tree" and way.sigma_m > self.rules.max_sigma_m:
            return self._reply(request, None, _vague(uav, way.sigma_m, self.rules.max_sigma_m))
        return self._claim(uav, request, way, now_ns)

    # -- judging

    def _claim(self, uav: str, request: ClaimRequest, way: Stretch, now_ns: int) -> ClaimReply:
        if now_ns < self.silent_until_ns:
            left_s = (self.silent_until_ns - now_ns) / 1e9
            return self._reply(
                request, None, f"the arbiter was started without its book: it grants again in {left_s:.0f} s"
            )
        goal = request.goal
        visited = self._visited(way) if goal.kind == "tree" and not request.again else None
        if visited is not None:
            return self._reply(request, None, f"{visited.uav} has docked at this tree", final=True)
        held = self._conflict(uav, way)
        if held is not None:
            return self._reply(request, None, self._who(held, way))
        if sum(lease.uav == uav for lease in self.leases.values()) >= _MOST_LEASES_EACH:
            return self._reply(request, None, f"{uav} holds {_MOST_LEASES_EACH} claims already")
        lease = Lease(uav, request.lease_id, goal.kind, way, goal.radius_m, self.rules.lease_s, goal.tree_id)
        return self._grant(lease, request, now_ns)

    def _renew(self, own: Lease, request: ClaimRequest, way: Stretch, now_ns: int) -> ClaimReply:
        """Extend; the stretch shrinks as the aircraft goes along it, which is never nearer to anybody.

        Before a trunk the aircraft comes back: it backs off along what it came by, which stays its own.
        """
        if math.dist(own.way.to_m, way.to_m) > _MOVED_M:
            held = self._conflict(own.uav, way)
            if held is not None:
                return self._reply(request, None, f"the map moved: {self._who(held, way)}")
            return self._grant(replace(own, way=way), request, now_ns)
        shrunk = own.way.ahead_of(way.from_m, self.rules.keep_m if own.kind == "tree" else 0.0)
        until_ns = now_ns + _ns(own.lease_s)
        self.leases[own.uav, own.lease_id] = replace(own, way=shrunk, until_ns=max(until_ns, own.until_ns))
        return self._reply(request, own.lease_s, "renewed")

    def _grant(self, lease: Lease, request: ClaimRequest, now_ns: int) -> ClaimReply:
        key = lease.uav, lease.lease_id
        before = self.leases.get(key)
        self.leases[key] = replace(lease, until_ns=now_ns + _ns(lease.lease_s))
        try:
            self.remember(self._memory())
        except OSError as error:
            if before is None:
                del self.leases[key]
            else:
                self.leases[key] = before
            return self._reply(request, None, f"the arbiter cannot write its book: {error.strerror}")
        return self._reply(request, lease.lease_s, "granted")

    def _take_done(self, uav: str, request: ClaimRequest, way: Stretch) -> ClaimReply:
        """Take note of a fact: it needs no lease, and a repeated word changes nothing."""
        new = Done(uav, way.to_m, way.sigma_m, request.goal.tree_id)
        if new not in self.done and len(self.done) < _MOST_DONE:
            self.done.append(new)
            try:
                self.remember(self._memory())
            except OSError as error:
                self.done.pop()
                return self._reply(request, None, f"the arbiter cannot write its book: {error.strerror}")
        return self._reply(request, 0.0, "noted")

    def _visited(self, way: Stretch) -> Done | None:
        def near(d: Done) -> bool:
            return math.dist(d.at_m, way.to_m) < self.rules.same_tree_m + 2.0 * math.hypot(d.sigma_m, way.sigma_m)

        return next((d for d in self.done if near(d)), None)

    def _conflict(self, uav: str, way: Stretch) -> Lease | None:
        others = [lease for lease in self.leases.values() if lease.uav != uav]
        near = [lease for lease in others if lease.way.gap_m(way) < self.rules.separation_m + lease.way.doubt_m(way)]
        return min(near, key=lambda lease: lease.way.gap_m(way), default=None)

    def _who(self, held: Lease, way: Stretch) -> str:
        if held.kind == "tree" and math.dist(held.way.to_m, way.to_m) < self.rules.same_tree_m + held.way.doubt_m(way):
            return f"{held.uav} holds this tree"
        what = {"tree": "its way to a tree passes", "place": "it stands", "way": "its way home passes"}[held.kind]
        return f"{held.uav} is too near: {what} here"

    # -- keeping

    def _expire(self, now_ns: int) -> None:
        self.leases = {key: lease for key, lease in self.leases.items() if lease.until_ns > now_ns}

    def _memory(self) -> Memory:
        return Memory(tuple(self.leases.values()), tuple(self.done))

    def _reply(
        self, request: ClaimRequest, lease_s: float | None, reason: str, *, final: bool = False
    ) -> ClaimReply:  # fmt: skip
        granted = lease_s is not None
        return ClaimReply(arbiter=self.name, lease_id=request.lease_id, granted=granted, lease_s=lease_s or 0.0,
                          reason=reason[:400], final=final)  # fmt: skip


def _vague(uav: str, sigma_m: float, most_m: float) -> str:
    return (
        f"{uav}'s place is known to {sigma_m:.1f} m only, {most_m:g} m are needed to tell trees apart: measure its start "
        "point better (station.inventory.start_points: sigma_m, sigma_heading_deg), or fly until the inventory has laid "
        "its trees on the others'"
    )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
