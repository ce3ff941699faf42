"""Configuration of claims: the arbiter's rules (``station.fleet``) and the aircraft's (``navigator.claims``)."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, model_validator


class FleetConfig(BaseModel):
    """The arbiter. Exactly one station of a fleet has it enabled."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = False
    """Answer the claims of aircraft; they need ``navigator.claims.enabled`` to ask."""
    lease_s: float = Field(default=40.0, ge=2.0, le=600.0)
    """How long a claim holds without a word from the aircraft; also how long an arbiter without its book waits."""
    separation_m: float = Field(default=3.0, gt=0.0)
    """No two claims of different aircraft come nearer: each may stand 0.95 m from its trunk on either side, is 0.35 m
    wide (``navigator.aircraft_radius_m``), and 0.4 m are left between them."""
    keep_m: float = Field(default=2.0, ge=0.0, le=20.0)
    """Of a way to a tree the last part stays claimed while the aircraft is docked: it backs off along it, by
    ``navigator.undock_m`` (1.8 m) from the trunk; where that is larger, this has to be."""
    same_tree_m: float = Field(default=0.5, gt=0.0)
    """A tree this near to a visited one (and twice the doubt of both places) is that tree."""
    max_sigma_m: float = Field(default=0.5, gt=0.0)
    """A tree whose place is known worse than this is refused: nobody could tell which one is meant."""
    book: str = ""
    """File that leases and visited trees are kept in; empty: fleet.json beside the inventory's usual file."""


class ClaimConfig(BaseModel):
    """The aircraft's side. Off by default: a single aircraft asks nobody."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = False
    clock_margin: float = Field(default=0.03, ge=0.0, lt=0.5)
    """Share of a lease that is not used: two clocks that run 1 % wrong, one each way, differ by 2.02 %."""
    renew_s: float = Field(default=3.0, gt=0.0)
    retry_s: float = Field(default=1.0, gt=0.0)
    """An unanswered question is asked again after this."""
    ask_timeout_s: float = Field(default=0.9, gt=0.0)
    again_s: float = Field(default=3.0, gt=0.0)
    """A tree that another holds is asked for again after this."""
    reserve_s: float = Field(default=18.0, gt=0.0)
    """With less than this left the aircraft holds: so much is needed to hold, back off and land while still alone."""
    hold_s: float = Field(default=5.0, gt=0.0)
    """Then, without a renewal, it backs off and lands."""
    give_way_s: float = Field(default=40.0, gt=0.0)
    """After waiting so long away from its start, longer than another needs for one tree, it flies back there and asks on:
    two that wait for each other's place would both go home without their trees."""
    wait_s: float = Field(default=90.0, gt=0.0)
    """How long to wait for trees that others hold, or for a free way home, before giving up."""

    @model_validator(mode="after")
    def _in_order(self) -> ClaimConfig:
        if self.hold_s >= self.reserve_s:
            raise ValueError(
                "claims.hold_s must be below claims.reserve_s: what is left is for backing off and landing"
            )
        return self
