"""Frames whose stamp stands alone: one wrong stamp far ahead would make all that follow it look late. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from schemas.camera import RgbdFrame
from services.camera.sources.base import BadFrame

JUMP_NS = 60_000_000_000
"""Stamps that differ by more are not of one stretch of frames: the recording paused, a clock was set, or a stamp is wrong."""


def without_strays(frames: Iterable[RgbdFrame | BadFrame]) -> Iterator[RgbdFrame | BadFrame]:
    """Yield the frames in their order, those with a stray stamp as bad ones.

    A frame that jumps ahead, and the first of all, wait for the one after them: only that tells a pause (it goes on from
    there) from a wrong stamp (it goes on from where the others were).
    """
    last_ns: int | None = None
    held: RgbdFrame | None = None
    for item in frames:
        if isinstance(item, BadFrame):
            yield item
            continue
        if held is not None:
            if _stray(held.stamp_ns, last_ns, item.stamp_ns):
                yield _told(held, item, last_ns)
            else:
                yield held
                last_ns = held.stamp_ns
            held = None
        if last_ns is None or item.stamp_ns - last_ns > JUMP_NS:
            held = item
            continue
        yield item
        last_ns = max(last_ns, item.stamp_ns)
    if held is not None:
        yield held


def _stray(held_ns: int, last_ns: int | None, next_ns: int) -> bool:
    """Return whether what follows goes on from before the held frame, far behind it."""
    return held_ns - next_ns > JUMP_NS and (last_ns is None or 0 < next_ns - last_ns <= JUMP_NS)


def _told(held: RgbdFrame, after: RgbdFrame, last_ns: int | None) -> BadFrame:
    before = "" if last_ns is None else f"the one before has {last_ns * 1e-9:.3f} s, "
    return BadFrame(
        held.stamp_ns,
        f"frame {held.seq}: its stamp {held.stamp_ns * 1e-9:.3f} s stands alone: {before}the one after "
        f"{after.stamp_ns * 1e-9:.3f} s",
    )
