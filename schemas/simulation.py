"""The simulator's own keys: its clock, and the truth that no flying process may read."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Part, StampNs, Vec3
from schemas.slam import Transform


class SimClock(Message):
    """Simulated time. It stands still while the simulator waits for slam and refiner (lockstep)."""

    SCHEMA: ClassVar[str] = "treedock.simclock"

    stamp_ns: StampNs
    seq: Counter
    phase: Literal["waiting", "running", "done"]
    """waiting: not begun (services missing); done: the scripted path or the mission is over."""
    frames: Counter


class TrueTree(Part):
    """A trunk as the scene defines it: axis point at the ground, radius at breast height."""

    x_m: float
    y_m: float
    z_m: float
    axis: Vec3
    radius_m: Annotated[float, Field(gt=0.0)]
    suitable: bool
    fair: bool
    """It could be seen: within range and unhidden on the scripted path."""


class SimTruth(Message):
    """Where the camera truly is, and the trees of the scene, in the true ``map`` frame (first camera pose)."""

    SCHEMA: ClassVar[str] = "treedock.simtruth"
    MAX_BYTES: ClassVar[int] = 1024 * 1024

    stamp_ns: StampNs
    seq: Counter
    scene: Name
    T_map_camera: Transform
    trees: Annotated[tuple[TrueTree, ...], Field(max_length=2_000)]
    touched: Annotated[int, Field(ge=0)]
    """How often the aircraft's body touched something so far."""
    clearance_m: float
    """Smallest distance from the aircraft's centre to any surface so far; negative is not possible."""
