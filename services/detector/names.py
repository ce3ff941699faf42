"""Which trunk bears which id, kept from one run of the detector to the next. Pure but for the one file.

The file is written before a list that names a new tree goes out: no later detector can give that id to another tree.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.envelope import Counter, Name
from services.common.state import StateFile, boot_id
from services.detector.identity import Identities, TrackedTree
from services.detector.map_store import Anchor, MapStore
from services.detector.model import Trunk

LOG = logging.getLogger(__name__)

_MAGIC = b"treedock tree ids "
_CHECKSUM = 8
_EVERY_NS, _AGAIN_NS = 1_000_000_000, 10_000_000_000
"""While no tree comes or goes the file is written so often (the trees follow the map by their anchors), and so seldom
where the disk refused."""

Row = tuple[float, float, float, float]


class SavedAnchor(BaseModel):
    """A submap and where it stood."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    submap_id: int
    T_map_submap: tuple[Row, Row, Row]


class SavedTree(BaseModel):
    """A tree with its id; its place is in the map as it was when the tree's anchor stood where it is said to stand."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: Annotated[int, Field(ge=1)]
    observations: Annotated[int, Field(ge=0)]
    missed: Annotated[int, Field(ge=0)]
    trunk: Trunk
    anchor: SavedAnchor | None


class SavedNames(BaseModel):
    """All that the next run has to know."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal[1] = 1
    boot: str = Field(default_factory=boot_id)
    """Of the machine."""
    map_id: Name
    graph_version: Counter
    list_version: Counter
    next_id: Annotated[int, Field(ge=1)]
    trees: tuple[SavedTree, ...]

    def tracked(self) -> list[TrackedTree]:
        """Return the trees as the detector follows them."""
        return [
            TrackedTree(t.id, t.trunk, t.observations, t.missed, _anchor(t.anchor) if t.anchor else None)
            for t in self.trees
        ]


def pack(names: SavedNames) -> bytes:
    """Return the file: a line with the checksum, then JSON."""
    return framed(names.model_dump_json().encode())


def framed(body: bytes) -> bytes:
    """Return the bytes of a file around its JSON."""
    return _MAGIC + b"%08x\n" % zlib.crc32(body) + body


def unpack(data: bytes) -> SavedNames:
    """Return what a file holds.

    Raises:
        ValueError: cut short, damaged, of another format.
    """
    if not data.startswith(_MAGIC):
        raise ValueError(f"does not begin as saved tree ids ({len(data)} bytes)")
    at = len(_MAGIC) + _CHECKSUM
    body = data[at + 1 :]
    if data[len(_MAGIC) : at + 1] != b"%08x\n" % zlib.crc32(body):
        raise ValueError("is damaged (checksum)")
    try:
        return SavedNames.model_validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"is not understood: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def saved_trees(trees: Sequence[TrackedTree]) -> tuple[SavedTree, ...]:
    """Return trees in the words of the file."""
    return tuple(
        SavedTree(
            id=t.tree_id, observations=t.observations, missed=t.missed, trunk=t.trunk,
            anchor=None if t.anchor is None else SavedAnchor(
                submap_id=t.anchor.submap_id, T_map_submap=t.anchor.T_map_submap[:3].tolist()
            ),
        )
        for t in trees
    )  # fmt: skip


def _anchor(saved: SavedAnchor) -> Anchor:
    return Anchor(saved.submap_id, np.vstack([np.array(saved.T_map_submap), [0.0, 0.0, 0.0, 1.0]]))


class NamesKeeper:
    """Writes the names when they change, and gives back those of the run before."""

    def __init__(self, folder: Path, uav: str, count: Callable[[str], None], note: Callable[[str, str], None]) -> None:
        """Keep the file in ``folder``; ``count`` and ``note`` are the health book's."""
        self._file = StateFile(folder / f"trees-{uav}.ids", "tree_id", "the numbering of trees", count, note)
        self._content: tuple[str, tuple[int, ...]] = ("", ())
        """Map and trees at the last writing."""
        self._due_ns = 0

    def load(self) -> SavedNames | None:
        """Return what the last run of this boot kept: no map of slam's outlives the machine's."""
        saved = self._file.read(unpack)
        return saved if saved is not None and saved.boot == boot_id() else None

    def due(self, map_id: str, trees: Sequence[TrackedTree], now_ns: int) -> bool:
        """Return whether to write: at once when a tree came, went or the map is another, else now and then."""
        return (map_id, tuple(t.tree_id for t in trees)) != self._content or now_ns >= self._due_ns

    def keep(self, names: SavedNames, now_ns: int) -> None:
        """Write ``names``."""
        fault = self._file.write([pack(names)], lasting=False)
        self._content = names.map_id, tuple(t.id for t in names.trees)
        self._due_ns = now_ns + (_AGAIN_NS if fault else _EVERY_NS)
        self._file.tell_written(fault)


@dataclass(frozen=True, slots=True)
class TakingUp:
    """Trees that are known while their map is not here, because this service or the mapper was started again.

    Meanwhile no list is made: half a map would withdraw trees that stand, or show under a new id what has one. Whoever
    flies keeps the last list, in which every tree stands under its id, and brakes for all of them.
    """

    graph_version: int
    """Of the map that they were last seen in."""
    since_ns: int
    saved: bool
    """They come from the run before, which ended nobody knows how long ago."""

    def over(self, identities: Identities, store: MapStore, now_ns: int, patience_s: float) -> bool:
        """Return whether lists may be made again: the map is whole, or was waited for long enough.

        A saved tree then stays only if its place in the present map is known: the map has not changed, or an anchor
        tells how.
        """
        poses, anchors = store.poses(), identities.anchors.keys()
        back = len(anchors & poses.keys())
        whole = store.complete and 2 * back >= len(anchors)  # the mapper may have thinned some away
        if not whole and now_ns - self.since_ns < patience_s * 1e9:
            return False
        gone = []
        if self.saved and store.graph_version < self.graph_version:
            gone = [tree.tree_id for tree in identities.trees]  # another map that bears the name of the old
            identities.clear()
        elif self.saved and store.graph_version > self.graph_version:
            gone = identities.forget_unled(poses)
        LOG.info(
            "%d trees keep their ids%s; the map is %s", len(identities.trees),
            f", {gone} are given up: where they stand in the map of now is not known" if gone else "",
            "whole" if whole else f"not whole after {patience_s:g} s",
        )  # fmt: skip
        return True
