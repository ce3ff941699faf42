"""What every source of frames has in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from schemas.camera import RgbdFrame


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame that cannot be used, where it should have come."""

    stamp_ns: int
    reason: str
    """One line: the file and its fault."""


class Source(Protocol):
    """Frames in the order in which they came, uncompressed; a bad one comes as a BadFrame.

    Opening a source raises InputError when it cannot be used at all; iterating does not raise for bad data.
    """

    name: str
    expected: int | None
    """How many frames (good or bad) will come, when that is known."""
    paced: bool
    """True when a live replay must wait for the stamps; false for a sensor that sets its own pace."""
    remark: str
    """What is odd about the recording as a whole, in one line; empty for nothing."""

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield the frames once."""
        ...
