"""Join flights that saw the same trees: one attempt at a time, between commits. Pure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from services.inventory.align import Alignment, Prior, align
from services.inventory.config import InventoryConfig
from services.inventory.merge import Spots, partners
from services.inventory.values import Flight, InventoryTree, Rigid2, Sighting

if TYPE_CHECKING:
    from services.inventory.book import Inventory

_PRIOR_SIGMAS = 3.0
_NEWS_SHARE = 1.05
"""A flight is laid on a site again when both have grown by so much since it was tried last."""


class Joiner:
    """Lays the flights of an inventory on each other."""

    def __init__(self, book: Inventory, config: InventoryConfig) -> None:
        self._book = book
        self._config = config
        self._tried: dict[tuple[int, int], int] = {}

    def join_next(self, now_ns: int) -> bool:
        """Try to lay one flight on one site (its own; without a start point any other local one); 10 to 20 ms.

        Returns:
            Whether there was anything to try: call again until there is not, but not all at once.
        """
        trees: dict[int, list[InventoryTree]] = {}
        for tree in self._book.trees.values():
            if tree.status == "present":
                trees.setdefault(tree.site, []).append(tree)
        for flight in self._book.flights.values():
            if flight.aligned:
                continue
            sightings = [s for s in self._book.of_flight[flight.fid].values() if s.present]
            for site in self._sites_to_try(flight):
                own = {s.tree for s in sightings} if site == flight.site else set()
                known = [t for t in trees.get(site, ()) if t.fid not in own]
                least, size = self._config.align_min_trees, len(sightings) + len(known)
                enough = len(sightings) >= least and len(known) >= least
                if enough and size > _NEWS_SHARE * self._tried.get((flight.fid, site), 0):
                    self._tried[flight.fid, site] = size
                    self._try(flight, sightings, site, known, now_ns)
                    return True
        return False

    def _try(
        self, flight: Flight, sightings: list[Sighting], site: int, known: list[InventoryTree], now_ns: int
    ) -> None:
        prior = None
        if flight.frame == "global":
            turn_rad, shift_m = max(flight.sigma_heading_rad, 0.01), max(flight.sigma_m, 0.1)
            prior = Prior(_PRIOR_SIGMAS * turn_rad * math.sqrt(2.0), _PRIOR_SIGMAS * shift_m * math.sqrt(2.0))
        placed = self._book.placed(flight, [s.belief for s in sightings])
        found = align(placed, Spots.of_trees(known), self._config, prior)
        if found is not None:
            self._join(flight, site, found, now_ns)

    def _sites_to_try(self, flight: Flight) -> list[int]:
        if flight.frame == "global":
            return [flight.site]
        occupied = {f.site for f in self._book.flights.values() if f.fid != flight.fid}
        # the older one stays where it is, but whatever lies on the globe stays there
        return sorted(
            s for s in occupied if s != flight.site and (s < flight.site or self._book.sites[s].frame == "global")
        )

    def _join(self, flight: Flight, site: int, found: Alignment, now_ns: int) -> None:
        """Lay the flight on the site by what was found, and its trees onto the trees there.

        A site that it leaves comes along whole: its flights share trees, which cannot lie in two frames.
        """
        book, turn = self._book, Rigid2(found.theta_rad, *found.shift_m)
        if site == flight.site:
            along: list[Flight] = []
            seen = {s.tree for s in book.of_flight[flight.fid].values()}
            trees = [
                book.trees[k] for k in sorted(seen) if all(s.flight == flight.fid for s in book.of_tree[k].values())
            ]
        else:
            along = [f for f in book.flights.values() if f.site == flight.site and f is not flight]
            trees = [t for t in book.trees.values() if t.site == flight.site]
        self._lay(flight, site, turn, f"by {found.agreeing} trees, {found.rms_m:.2f} m")
        flight.sigma_m, flight.sigma_heading_rad = max(found.rms_m, 0.02), 0.01
        for other in along:
            self._lay(other, site, turn, f"with flight {flight.fid}")
            other.sigma_m = math.hypot(other.sigma_m, flight.sigma_m)
            other.sigma_heading_rad = math.hypot(other.sigma_heading_rad, flight.sigma_heading_rad)
        self._move_trees(trees, site, turn)
        gained = self._merge(flight, [t for t in trees if t.status != "merged"])
        for fid in sorted(gained | {s.tree for s in book.of_flight[flight.fid].values()}):
            book.refresh(fid, now_ns)

    def _lay(self, flight: Flight, site: int, turn: Rigid2, by: str) -> None:
        place = flight.place
        x, y, _ = turn.apply(place.x_m, place.y_m, 0.0)
        flight.place = replace(place, theta_rad=place.theta_rad + turn.theta_rad, x_m=x, y_m=y)
        flight.site, flight.frame, flight.aligned = site, self._book.sites[site].frame, True
        flight.note = f"laid on the inventory {by}{'' if flight.frame == 'global' else '; local coordinates'}"
        self._book.changes.flights[flight.fid] = flight

    def _move_trees(self, trees: list[InventoryTree], site: int, turn: Rigid2) -> None:
        frame = self._book.sites[site].frame
        for tree in trees:
            if tree.frame == "local" and frame == "global":
                self._book.changes.placed.append(tree.fid)
            tree.x_m, tree.y_m, _ = turn.apply(tree.x_m, tree.y_m, 0.0)
            tree.site, tree.frame = site, frame
            self._book.changes.trees[tree.fid] = tree

    def _merge(self, flight: Flight, trees: list[InventoryTree]) -> set[int]:
        """Make trees those of the flight's site that they are; return these."""
        apart = {t.fid for t in trees} | {s.tree for s in self._book.of_flight[flight.fid].values() if s.present}
        others = [
            t for t in self._book.trees.values()
            if t.site == flight.site and t.status != "merged" and t.fid not in apart
        ]  # fmt: skip
        found = partners(Spots.of_trees(trees), [t.status == "present" for t in trees], others, self._config)
        for tree, other in zip(trees, found, strict=True):
            if other is not None:
                self._relink(tree, other)
        return {other.fid for other in found if other is not None}

    def _relink(self, left: InventoryTree, to: InventoryTree) -> None:
        """Make a tree's sightings another tree's; the tree they leave stays as merged, so that no number is lost."""
        left.status, left.merged_into = "merged", to.fid
        to.visited |= left.visited
        to.first_ns = min(to.first_ns, left.first_ns)
        self._book.changes.trees[left.fid] = left
        for sighting in self._book.of_tree[left.fid].values():
            sighting.tree = to.fid
            self._book.changes.sightings[sighting.fid] = sighting
        self._book.of_tree[to.fid] |= self._book.of_tree[left.fid]
        self._book.of_tree[left.fid] = {}
