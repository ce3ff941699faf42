"""The operator's orders: what each does in which state, and why it is refused. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from schemas.navigation import MissionStateName
from schemas.orders import CommandName
from services.navigator.failsafe import AIRBORNE, Fault
from services.navigator.values import Next

if TYPE_CHECKING:
    from services.navigator.mission import Mission

_GROUNDED: frozenset[MissionStateName] = frozenset({"idle", "landed", "failed", "released"})


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer to an order."""

    accepted: bool
    reason: str


def carry_out(m: Mission, name: CommandName, tree_id: int | None, now_ns: int) -> Verdict:
    """Carry out an order, or say why not."""
    if name == "start":
        return _start(m, now_ns)
    if m.state not in AIRBORNE | {"preflight"}:
        return _no(f"nothing to {name}: the mission is {m.state}")
    if name in ("abort", "land"):
        return _come_down(m, name, now_ns)
    if name == "hold":
        return _hold(m, now_ns)
    if name == "resume":
        return _resume(m, now_ns)
    return _choose(m, tree_id, now_ns) if name == "choose" else _next(m, now_ns)


def _start(m: Mission, now_ns: int) -> Verdict:
    v = m.board.vehicle
    if m.state not in _GROUNDED:
        return _no(f"a mission is under way: {m.state}")
    if not m.config.handheld:
        if v is None:
            return _no("no word from the autopilot: is the bridge running and the vehicle connected?")
        if v.armed:
            return _no("the vehicle is armed: a mission starts from the ground, disarmed")
    m.begin(now_ns)
    return _yes(m.reason)


def _hold(m: Mission, now_ns: int) -> Verdict:
    if _on_ground(m):  # it would arm and then hold in the air: whoever says hold wants nothing to happen
        return _come_down(m, "hold", now_ns)
    limit_s = m.config.failsafe.operator_hold_s
    m.hold(Fault("", "hold", "the operator said hold", limit_s), "operator", now_ns)
    return _yes("holding")


def _come_down(m: Mission, name: str, now_ns: int) -> Verdict:
    if _on_ground(m):
        m.go(Next("landed", f"{name} ordered before take-off"), now_ns)
    else:
        m.go(Next("landing", f"{name} ordered"), now_ns)
    return _yes(m.reason)


def _on_ground(m: Mission) -> bool:
    return m.state == "preflight" or (m.state == "take_off" and not m.watch.armed)


def _resume(m: Mission, now_ns: int) -> Verdict:
    if m.state != "hold":
        return _no(f"nothing to resume: the mission is {m.state}")
    if m.fault is not None:
        return _no(f"cannot resume yet: {m.fault.word}")
    m.leave_hold("the operator said resume", now_ns)
    return _yes(m.reason)


def _choose(m: Mission, tree_id: int | None, now_ns: int) -> Verdict:
    b = m.board
    tree = next((t for t in b.trees if t.id == tree_id), None)
    if tree is None:
        known = ", ".join(str(t.id) for t in b.trees) or "none"
        return _no(f"no tree {tree_id} in the list (known: {known})")
    if not tree.suitable:
        return _no(f"tree {tree_id} is not suitable")
    if tree.id in b.visited_ids:
        b.trees_wanted += 1
    b.wanted_id = tree.id
    if m.state in ("face", "approach"):
        b.drop_target()
        m.go(Next("select", f"the operator chose tree {tree_id}"), now_ns)
    elif m.state in ("dock", "docked"):
        b.further_tree()
        m.go(Next("undock", f"the operator chose tree {tree_id}"), now_ns)
    elif m.state == "undock":
        b.further_tree()
    elif m.state == "return" and not b.giving_way:
        b.further_tree()
        m.go(Next("select", f"the operator chose tree {tree_id}"), now_ns)
    elif m.state == "hold":
        m.choose_after_hold()
    return _yes(f"tree {tree_id} is next")


def _next(m: Mission, now_ns: int) -> Verdict:
    b = m.board
    if m.state not in ("face", "approach", "dock", "docked"):
        return _no(f"no target to leave: the mission is {m.state}")
    if m.state != "docked":
        b.finish_target(visited=False)
    b.trees_wanted = max(b.trees_wanted, b.docked_count + 1)
    if m.state in ("dock", "docked"):
        m.go(Next("undock", "the operator said next"), now_ns)
    else:
        b.drop_target()
        m.go(Next("select", "the operator said next"), now_ns)
    return _yes("the next tree")


def _yes(reason: str) -> Verdict:
    return Verdict(accepted=True, reason=reason)


def _no(reason: str) -> Verdict:
    return Verdict(accepted=False, reason=reason)
