"""Claims on trees as the mission sees them: what it holds, what it wants, what was refused. Pure.

Nothing changes where they are switched off. Where they are on, the aircraft claims the place that it starts from, then
each tree before it is chosen, then the way home, and holds what it has until the next is granted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from schemas.fleet import ClaimGoal, GoalKind
from schemas.navigation import MissionStateName
from schemas.trees import Tree
from services.common.geometry import Matrix
from services.fleet.config import ClaimConfig
from services.fleet.holder import ClaimView, Wish, same_goal

if TYPE_CHECKING:
    from services.navigator.board import Board

Answer = Literal["held", "asking", "refused"]

_ON_THE_GROUND: frozenset[MissionStateName] = frozenset({"idle", "landed", "failed", "released"})
_FREE: frozenset[MissionStateName] = frozenset({"landing", "preflight"})
"""States that go on without a claim: coming down is the answer to its loss."""
_COME_DOWN_S = 8.0
"""With less left of a lost claim the aircraft comes down from where it is: from 3 m that takes 6 s."""


@dataclass
class Claims:
    """The mission's memory of its claims."""

    config: ClaimConfig
    view: ClaimView = field(default_factory=ClaimView)
    done: bool = False
    """The held tree was docked at in this step."""
    leaving: bool = False
    """Backing off to land because the claim was lost."""
    _wanted: ClaimGoal | None = None
    _again: bool = False
    _now_ns: int = 0
    _heard: int | None = None
    """Number of the last refusal that was acted upon; what was refused to the mission before is none of this one's."""
    _final: dict[int, str] = field(default_factory=dict)
    _held_by_others: dict[int, tuple[str, int]] = field(default_factory=dict)
    """Why, and until when (ns) the tree is not asked for again."""
    _waiting: tuple[GoalKind, int] | None = None
    """What is wanted and not held, since when (ns)."""
    _not_before_ns: int = 0
    """A refused place or way is asked for again after this."""

    @property
    def on(self) -> bool:
        """Whether trees are claimed at all."""
        return self.config.enabled

    def take(self, view: ClaimView | None, now_ns: int) -> None:
        """Begin a step."""
        self.view, self._now_ns = view or ClaimView(), now_ns
        self._wanted, self._again, self.done = None, False, False
        if self._heard is None:
            self._heard = 0 if self.view.refusal is None else self.view.refusal.number

    def forget(self) -> None:
        """Forget the trees by number: the map is another."""
        self._final.clear()
        self._held_by_others.clear()

    def want(self, goal: ClaimGoal, *, again: bool = False) -> Answer:
        """Want a goal in this step; it is asked for until it is granted or refused."""
        held, refusal = self.view.held, self.view.refusal
        if held is not None and same_goal(held, goal):
            self._waiting = None
            return "held"
        if self._waiting is None or self._waiting[0] != goal.kind:
            self._waiting = (goal.kind, self._now_ns)
        if goal.tree_id is None and self._now_ns < self._not_before_ns:
            return "refused"
        if refusal is not None and refusal.number > (self._heard or 0) and same_goal(refusal.goal, goal):
            self._heard = refusal.number
            if goal.tree_id is None:
                self._not_before_ns = self._now_ns + round(1e9 * self.config.again_s)
            else:
                self._refuse(goal.tree_id, refusal.reason, final=refusal.final)
            return "refused"
        self._wanted, self._again = goal, again
        return "asking"

    def _refuse(self, tree_id: int, reason: str, *, final: bool) -> None:
        if final:
            self._final[tree_id] = reason
        else:
            self._held_by_others[tree_id] = (reason, self._now_ns + round(1e9 * self.config.again_s))

    # -- what the states ask

    @property
    def closed_ids(self) -> set[int]:
        """Trees that are not to be asked for at present."""
        return {*self._final, *(i for i, (_, until_ns) in self._held_by_others.items() if until_ns > self._now_ns)}

    @property
    def awaited(self) -> str:
        """Which trees others hold, and who; empty when there is none to wait for."""
        held = {i: why for i, (why, _) in self._held_by_others.items() if i not in self._final}
        return "; ".join(f"tree {i}: {why}" for i, why in sorted(held.items()))

    @property
    def closed_words(self) -> str:
        """Why trees are closed for good, the first of them."""
        return next((f"tree {i}: {why}" for i, why in sorted(self._final.items())), "")

    @property
    def waited_s(self) -> float:
        """Return since when something is wanted that is not held."""
        return 0.0 if self._waiting is None else (self._now_ns - self._waiting[1]) / 1e9

    def wait_only_for(self, tree_ids: set[int]) -> None:
        """Wait no longer for other trees: done here, or no longer listed, so that they would never be asked for again."""
        self._held_by_others = {i: held for i, held in self._held_by_others.items() if i in tree_ids}

    @property
    def word(self) -> str:
        """What is being waited for."""
        refusal = self.view.refusal
        return self.view.note or (refusal.reason if refusal is not None else "") or "waiting for the arbiter"

    def backing_off(self, state: MissionStateName) -> bool:
        """Whether the claim is lost and acted upon: nothing shall stop the aircraft on its way from the trunk."""
        return self.leaving and state == "undock"

    @property
    def must_land(self) -> bool:
        """Whether what stopped the backing off may stop it no longer: the lease is about to end."""
        return self.leaving and self.view.left_s < _COME_DOWN_S

    def lost(self, state: MissionStateName) -> str:
        """Return why the aircraft can no longer count on its claim, empty while it can."""
        if not self.on or self.backing_off(state) or state in _ON_THE_GROUND | _FREE:
            return ""
        if self.view.broken:
            return f"claim lost: {self.view.broken}"
        if self.view.left_s >= self.config.reserve_s:
            return ""
        why = f": {self.view.note}" if self.view.note else ""
        return f"claim not renewed, {self.view.left_s:.0f} s left{why}"

    def wish(self, b: Board, state: MissionStateName) -> Wish:
        """Return what is to be told to the arbiter after this step."""
        armed = b.vehicle is not None and b.vehicle.armed
        over = state in _ON_THE_GROUND and not armed  # under the pilot it still stands where it stands
        here = b.here
        if here is None:
            return Wish(self._wanted, self._again, self._heard or 0, self.done, over)
        held = self.view.held
        to_m = None if held is None else _present(b, held)
        return Wish(
            self._wanted, self._again, self._heard or 0, self.done, over, _flat(here.position_m), to_m, here.map_id
        )


def start_goal(b: Board) -> ClaimGoal | None:
    """Return the place that the aircraft stands at; None without a pose."""
    return None if b.here is None else _goal(b, "place", _flat(b.here.position_m))


def home_goal(b: Board) -> ClaimGoal | None:
    """Return the way to the start."""
    return None if b.here is None or b.home_m is None else _goal(b, "way", _flat(b.home_m))


def tree_goal(b: Board, tree: Tree) -> ClaimGoal | None:
    """Return the way to a listed tree, by its foot: the part of it that all aircraft agree on best."""
    if b.here is None:
        return None
    goal = _goal(b, "tree", (tree.x_m, tree.y_m))
    return goal.model_copy(update={"radius_m": tree.radius_m, "sigma_m": tree.sigma_xy_m, "tree_id": tree.id})


def _goal(b: Board, kind: GoalKind, to_m: tuple[float, float]) -> ClaimGoal:
    assert b.here is not None
    return ClaimGoal(kind=kind, map_id=b.here.map_id, from_m=_flat(b.here.position_m), to_m=to_m)


def _present(b: Board, held: ClaimGoal) -> tuple[float, float] | None:
    """Return where the held goal stands now: a corrected map moves it; None: where it was."""
    if held.kind != "tree":
        return None if b.home_m is None or not b.home_known else _flat(b.home_m)
    tree = next((t for t in b.trees if t.id == held.tree_id), None)
    return None if tree is None or b.following.astray else (tree.x_m, tree.y_m)


def _flat(p: Matrix) -> tuple[float, float]:
    return float(p[0]), float(p[1])
