"""Frames whose stamp stands alone: one wrong stamp far ahead would make all that follow it look late. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from schemas.camera import RgbdFrame
from services.camera.sources.base import BadFrame

JUMP_NS = 60_000_000_000
"""Stamps that differ by more are not of one stretch of frames: the recording paused, a clock was set, or a stamp is wrong."""
_WAIT_FOR = 10
"""A frame that waits for its next lets no more bad ones wait behind it: a broken camera must be told."""


def without_strays(frames: Iterable[RgbdFrame | BadFrame]) -> Iterator[RgbdFrame | BadFrame]:
    """Yield the frames in their order, those with a stray stamp as bad ones.

    A frame that jumps ahead, and the first of all, wait for the one after them: only that tells a pause (it goes on from
    there) from a wrong stamp (it goes on from where the others were).
    """
    last_ns: int | None = None
    held: RgbdFrame | None = None
    behind: list[BadFrame] = []
    for item in frames:
        if isinstance(item, BadFrame):
            behind.append(item)
            if held is None or len(behind) > _WAIT_FOR:
                if held is not None:
                    yield held
                    last_ns = held.stamp_ns
                yield from behind
                held, behind = None, []
            continue
        if held is not None:
            stray = _stray(held.stamp_ns, last_ns, item.stamp_ns)
            yield _told(held, item, last_ns) if stray else held
            yield from behind
            last_ns = last_ns if stray else held.stamp_ns
            held, behind = None, []
        if last_ns is None or item.stamp_ns - last_ns > JUMP_NS:
            held = item
            continue
        yield item
        last_ns = max(last_ns, item.stamp_ns)
    if held is not None:
        yield held
        yield from behind


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
