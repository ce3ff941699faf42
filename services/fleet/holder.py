"""The aircraft's side of claims: what it asks, what it believes to hold, and until when. Pure: no bus, no clock.

All times are of the aircraft's own steady clock. A lease counts from before the question was sent, shortened by the
clocks' possible difference: the belief ends before the arbiter's own entry does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from schemas.fleet import ClaimGoal, ClaimKind, ClaimReply, ClaimRequest
from services.fleet.config import ClaimConfig


@dataclass(frozen=True, slots=True)
class Asked:
    """A question on its way: its time of sending comes back with the answer, on the same clock."""

    request: ClaimRequest
    sent_ns: int


@dataclass(frozen=True, slots=True)
class Held:
    """A lease as the aircraft believes in it."""

    lease_id: int
    goal: ClaimGoal
    until_ns: int
    refused: str = ""
    """Why a renewal was refused: it will not get longer."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """What the arbiter said."""

    goal: ClaimGoal
    reason: str
    final: bool
    number: int
    """Rises with every refusal: an old one is not taken for a new one."""


@dataclass(frozen=True, slots=True)
class ClaimView:
    """What the mission is told of its claims at one step."""

    held: ClaimGoal | None = None
    left_s: float = 0.0
    broken: str = ""
    """Why the held lease will not get longer."""
    refusal: Refusal | None = None
    note: str = ""
    undelivered: int = 0


@dataclass(frozen=True, slots=True)
class Wish:
    """What the mission wants of its claims at one step."""

    goal: ClaimGoal | None = None
    """To be claimed beside what is held; None: nothing more than that."""
    again: bool = False
    heard: int = 0
    """Number of the last refusal that this wish was made with."""
    done: bool = False
    release: bool = False
    at_m: tuple[float, float] | None = None
    """Where the aircraft is, in ``map_id``."""
    to_m: tuple[float, float] | None = None
    """Where the held goal stands by the present map."""
    map_id: str = ""


@dataclass
class Holder:
    """One aircraft's claims: at most one held and one asked for; trees done wait until the arbiter has confirmed them."""

    config: ClaimConfig
    new_id: Callable[[], int]
    held: Held | None = None
    asked: ClaimRequest | None = None
    refusal: Refusal | None = None
    """Of the last claim asked for."""
    arbiter: str = ""
    note: str = ""
    _refusals: int = 0
    _done: dict[int, ClaimRequest] = field(default_factory=dict)
    _give_back: dict[int, ClaimRequest] = field(default_factory=dict)
    _due_ns: dict[tuple[ClaimKind, int], int] = field(default_factory=dict)

    # -- what the mission wants

    def follow(self, wish: Wish) -> None:
        """Do what a step of the mission wants."""
        if wish.at_m is not None:
            self.at(wish.at_m, wish.to_m, wish.map_id)
        if wish.done:
            self.done()
        if wish.release:
            self.release()
        elif wish.goal is not None and not self._unheard(wish):
            self.claim(wish.goal, again=wish.again)
        elif wish.goal is None:
            self.withdraw()

    def _unheard(self, wish: Wish) -> bool:
        """Whether a refusal came that the mission has not seen yet: it must not be asked over."""
        r = self.refusal
        return r is not None and wish.goal is not None and r.number > wish.heard and same_goal(r.goal, wish.goal)

    def view(self, now_ns: int) -> ClaimView:
        """Return what the mission is to know at ``now_ns``."""
        left_s, held = self.left_s(now_ns), self.held
        if held is None or left_s <= 0.0:
            return ClaimView(refusal=self.refusal, note=self.note, undelivered=self.undelivered)
        return ClaimView(held.goal, left_s, held.refused, self.refusal, self.note, self.undelivered)

    def claim(self, goal: ClaimGoal, *, again: bool = False) -> None:
        """Ask for ``goal`` until it is granted or refused; another one that was asked for is withdrawn."""
        if self.asked is not None and same_goal(self.asked.goal, goal) and self.asked.again == again:
            return
        self.withdraw()
        self.refusal = None
        self.asked = ClaimRequest(kind="claim", lease_id=self.new_id(), goal=goal, again=again)

    def withdraw(self) -> None:
        """Ask no longer; the arbiter may have granted it meanwhile."""
        if self.asked is not None:
            self._return(self.asked.lease_id, self.asked.goal)
            self.asked = None

    def release(self) -> None:
        """Hold nothing and ask for nothing any more: believed no longer from here on, told at the next chance."""
        self.withdraw()
        if self.held is not None:
            self._return(self.held.lease_id, self.held.goal)
            self.held = None

    def done(self) -> None:
        """Tell that the held tree has been docked at, until the arbiter has confirmed it."""
        if self.held is not None and self.held.goal.kind == "tree":
            lease_id = self.held.lease_id
            self._done[lease_id] = ClaimRequest(kind="done", lease_id=lease_id, goal=self.held.goal)

    def at(self, from_m: tuple[float, float], to_m: tuple[float, float] | None, map_id: str) -> None:
        """Say where the aircraft is on its way, and where the goal stands by the present map."""
        if self.held is not None and self.held.goal.map_id == map_id:
            goal = self.held.goal
            goal = goal.model_copy(update={"from_m": from_m, "to_m": to_m or goal.to_m})
            self.held = replace(self.held, goal=goal)

    @property
    def undelivered(self) -> int:
        """How many trees done the arbiter has not confirmed."""
        return len(self._done)

    def left_s(self, now_ns: int) -> float:
        """Return how long the held lease lasts, 0 when there is none."""
        return 0.0 if self.held is None else max(0.0, (self.held.until_ns - now_ns) / 1e9)

    # -- the questions

    def questions(self, now_ns: int) -> list[Asked]:
        """Return what must be asked now; each of them is repeated until it is answered."""
        # a lease whose tree is done is given back, or followed by another, only when that is known at the arbiter:
        # else somebody could be granted the tree in between
        returned = [r for r in self._give_back.values() if r.lease_id not in self._done]
        wanted: list[ClaimRequest] = [*self._done.values(), *returned]
        if self.held is not None and not self.held.refused and self.left_s(now_ns) > 0.0:
            wanted.append(ClaimRequest(kind="renew", lease_id=self.held.lease_id, goal=self.held.goal))
        if self.asked is not None and not self._done:
            wanted.append(self.asked)
        due = [r for r in wanted if now_ns >= self._due_ns.get((r.kind, r.lease_id), 0)]
        alive = {(r.kind, r.lease_id) for r in wanted}
        self._due_ns = {key: at for key, at in self._due_ns.items() if key in alive}
        for request in due:
            self._due_ns[request.kind, request.lease_id] = now_ns + _ns(self.config.retry_s)
        return [Asked(request, now_ns) for request in due]

    def answered(self, asked: Asked, replies: Sequence[ClaimReply], now_ns: int) -> None:
        """Take what came back; nothing: it is asked again."""
        replies = [r for r in replies if r.lease_id == asked.request.lease_id]
        if not replies:
            if self.asked is not None and asked.request.kind == "claim":
                self.note = "the arbiter does not answer"
            return
        if len(replies) > 1:  # of one name too: a book that was copied to another station carries it
            names = ", ".join(sorted(r.arbiter for r in replies))
            self.note = f"two arbiters answer ({names}): one station only may have station.fleet.enabled"
            return
        reply, self.arbiter = replies[0], replies[0].arbiter
        {"claim": self._on_claim, "renew": self._on_renew, "done": self._on_done, "release": self._on_release}[
            asked.request.kind
        ](asked, reply, now_ns)

    def _on_claim(self, asked: Asked, reply: ClaimReply, now_ns: int) -> None:
        if self.asked is None or self.asked.lease_id != reply.lease_id:
            return  # withdrawn meanwhile: the release is on its way
        goal = self.asked.goal
        self.asked = None
        if not reply.granted:
            self.refusal, self.note = self._refused(goal, reply), reply.reason
            self._return(reply.lease_id, goal)  # an earlier asking of the same may have been granted, its answer lost
            return
        until_ns = self._until_ns(asked.sent_ns, reply.lease_s)
        if until_ns <= now_ns:
            self._return(reply.lease_id, goal)
            return
        if self.held is not None:
            self._return(self.held.lease_id, self.held.goal)
        self.held, self.note = Held(reply.lease_id, goal, until_ns), ""
        self._due_ns["renew", reply.lease_id] = now_ns + _ns(self.config.renew_s)

    def _refused(self, goal: ClaimGoal, reply: ClaimReply) -> Refusal:
        self._refusals += 1
        return Refusal(goal, reply.reason, reply.final, self._refusals)

    def _on_renew(self, asked: Asked, reply: ClaimReply, now_ns: int) -> None:
        held = self.held
        if held is None or held.lease_id != reply.lease_id:
            return
        if not reply.granted:
            self.held, self.note = replace(held, refused=reply.reason), reply.reason
            return
        # one that had run out is not believed in again: nobody held it meanwhile, but the mission has acted on it
        if held.until_ns > now_ns:
            until_ns = self._until_ns(asked.sent_ns, reply.lease_s)
            self.held = replace(held, until_ns=max(held.until_ns, until_ns))
        self._due_ns["renew", reply.lease_id] = now_ns + _ns(self.config.renew_s)

    def _on_done(self, asked: Asked, reply: ClaimReply, now_ns: int) -> None:
        del now_ns
        if reply.granted:
            self._done.pop(asked.request.lease_id, None)
        else:
            self.note = reply.reason

    def _on_release(self, asked: Asked, reply: ClaimReply, now_ns: int) -> None:
        del reply, now_ns
        self._give_back.pop(asked.request.lease_id, None)

    def _return(self, lease_id: int, goal: ClaimGoal) -> None:
        self._give_back[lease_id] = ClaimRequest(kind="release", lease_id=lease_id, goal=goal)
        while len(self._give_back) > _MOST_RETURNED:  # they run out by themselves
            del self._give_back[next(iter(self._give_back))]

    def _until_ns(self, sent_ns: int, lease_s: float) -> int:
        return sent_ns + _ns(lease_s * (1.0 - self.config.clock_margin))


_MOST_RETURNED = 16


def same_goal(a: ClaimGoal, b: ClaimGoal) -> bool:
    """Whether two goals mean the same, wherever the aircraft is on its way."""
    return (a.kind, a.map_id, a.tree_id) == (b.kind, b.map_id, b.tree_id)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
