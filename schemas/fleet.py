"""Claims on trees among several aircraft: the aircraft asks, the arbiter at the station grants for a duration.

No message carries a time of day: a lease is a duration, counted by each side on its own clock.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Part, StampNs, Text, TreeId

Vec2 = tuple[float, float]
ClaimKind = Literal["claim", "renew", "release", "done"]
GoalKind = Literal["place", "tree", "way"]
"""The place to start from; a tree to dock at; the way back to the start."""


class ClaimGoal(Part):
    """What is claimed: the straight way from where the aircraft is to where it wants to go, in its own map."""

    kind: GoalKind
    map_id: Name
    from_m: Vec2
    to_m: Vec2
    """The trunk's axis, or the place."""
    radius_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.0
    """Of the trunk."""
    sigma_m: Annotated[float, Field(ge=0.0)] = 0.0
    """Standard deviation of ``to_m`` in the map."""
    tree_id: TreeId | None = None
    """In the aircraft's own list: for people to read."""


class ClaimRequest(Message):
    """Ask for a lease, for more of it, give it back, or tell that its tree is done."""

    SCHEMA: ClassVar[str] = "treedock.claim"

    kind: ClaimKind
    lease_id: Counter
    """Made by the aircraft for each claim, the same in every message about it: a repeated claim is no second one."""
    goal: ClaimGoal
    again: bool = False
    """The operator wants this tree although somebody has docked at it before."""


class ClaimReply(Message):
    """Granted for so long, or why not."""

    SCHEMA: ClassVar[str] = "treedock.claim_reply"

    arbiter: Name
    """Which arbiter: two that answer the same aircraft are a fault."""
    lease_id: Counter
    granted: bool
    """For done and release: taken note of."""
    lease_s: Annotated[float, Field(ge=0.0, le=3600.0)]
    """How long from now; the aircraft counts it from before it asked."""
    reason: Text
    final: bool = False
    """Waiting does not help: the tree was visited, or something must be configured."""


class HeldState(Message):
    """An aircraft's own account of its claims, for the operator and the recording."""

    SCHEMA: ClassVar[str] = "treedock.held"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name
    held: ClaimGoal | None
    """What the aircraft believes to hold."""
    left_s: Annotated[float, Field(ge=0.0)]
    """Of its lease, by the aircraft's clock."""
    asked: ClaimGoal | None
    undelivered: Counter
    """Trees done whose word the arbiter has not confirmed."""
    note: Text = ""
    """Why the last claim was refused, or what is being waited for."""
