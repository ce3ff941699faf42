"""The mission's small world with claims: a holder aboard, an arbiter's book beside it, and a link that can be cut."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from schemas.fleet import ClaimRequest
from services.fleet.book import Book, Memory
from services.fleet.config import ClaimConfig, FleetConfig
from services.fleet.holder import ClaimView, Holder
from services.fleet.shapes import Stretch
from services.navigator.config import NavigatorConfig
from tests.fleet.lease_net import goal
from tests.unit.navigator_world import World


def ordered(**navigator: object) -> NavigatorConfig:
    return NavigatorConfig(claims=ClaimConfig(enabled=True), live_guard=False, **navigator)  # type: ignore[arg-type]


@dataclass
class ClaimsWorld(World):
    """Every question is answered at once, while the link is there."""

    config: NavigatorConfig = field(default_factory=ordered)
    linked: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = itertools.count(1)
        self.holder = Holder(self.config.claims, lambda: next(numbers))
        self.book = Book(FleetConfig(enabled=True), "arbiter", lambda _: None)
        self.book.begin(Memory(), self.now_ns)

    def claims(self) -> ClaimView:
        if self.outputs is not None:
            self.holder.follow(self.outputs.wish)
        for asked in self.holder.questions(self.now_ns):
            if self.linked:
                g = asked.request.goal
                reply = self.book.answer("uav1", asked.request, Stretch(g.from_m, g.to_m), self.now_ns)
                self.holder.answered(asked, [reply], self.now_ns)
            else:
                self.holder.answered(asked, [], self.now_ns)
        return self.holder.view(self.now_ns)

    def other_claims(self, x_m: float, y_m: float, *, done: bool = False) -> None:
        """Have another aircraft hold, or have docked at, the tree at a place."""
        there = goal(0).model_copy(update={"from_m": (x_m, y_m), "to_m": (x_m, y_m), "tree_id": 77})
        request = ClaimRequest(kind="done" if done else "claim", lease_id=900, goal=there)
        assert self.book.answer("uav2", request, Stretch(there.from_m, there.to_m), self.now_ns).granted

    @property
    def held(self) -> str:
        """Kind of what the aircraft holds, by the arbiter's own book."""
        live = [lease for lease in self.book.leases.values() if lease.uav == "uav1" and lease.until_ns > self.now_ns]
        return ",".join(sorted(lease.kind for lease in live))
