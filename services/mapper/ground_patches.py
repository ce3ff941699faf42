"""The ground model as messages: patches as it changes, the whole when asked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from schemas.mapping import GroundCell, GroundPatch
from services.mapper.dense_map import MapSubmap
from services.mapper.ground_model import CellIndex, GroundModel, GroundPlane

_PER_MESSAGE = 5000


@dataclass(frozen=True, slots=True)
class Occasion:
    """When a patch is made and of which map."""

    stamp_ns: int
    map_id: str
    graph_version: int


class GroundPatches:
    """Keeps the ground model up to date and numbers what is told of it."""

    def __init__(self, cell_m: float) -> None:
        self.model = GroundModel(cell_m)
        self.sequence = 0

    def changes(self, submaps: dict[int, MapSubmap], when: Occasion) -> list[GroundPatch]:
        """Do the touched cells again and return what changed as messages with new numbers."""
        change = self.model.refresh(submaps)
        if not change.cells and not change.gone:
            return []
        first = self.sequence + 1
        patches = self._patches(change.cells, change.gone, when, first)
        self.sequence += len(patches)
        return patches

    def whole(self, when: Occasion) -> list[GroundPatch]:
        """Return the whole ground, under the number of the last change."""
        return self._patches(self.model.cells, [], when, self.sequence) if self.model.cells else []

    def _patches(
        self, cells: dict[CellIndex, GroundPlane], gone: Iterable[CellIndex], when: Occasion, first: int
    ) -> list[GroundPatch]:
        items, lost = sorted(cells.items()), sorted(gone)
        starts = range(0, max(1, len(items), len(lost)), _PER_MESSAGE)
        parts = [(items[i : i + _PER_MESSAGE], lost[i : i + _PER_MESSAGE]) for i in starts]
        whole = first == self.sequence
        return [
            GroundPatch(
                stamp_ns=when.stamp_ns, map_id=when.map_id, graph_version=when.graph_version,
                sequence=first if whole else first + number, cell_m=self.model.cell_m,
                gone=tuple(left), cells=tuple(_message(at, plane) for at, plane in part),
            )
            for number, (part, left) in enumerate(parts)
        ]  # fmt: skip


def _message(at: CellIndex, plane: GroundPlane) -> GroundCell:
    return GroundCell(
        column=at[0], row=at[1], height_m=plane.height_m, slope_x=plane.slope_x, slope_y=plane.slope_y,
        relief_m=max(0.0, plane.relief_m), points=plane.points,
    )  # fmt: skip
