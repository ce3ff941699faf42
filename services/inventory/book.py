"""The inventory in memory: takes the lists of flights, joins trees, and says what must be written. Pure.

A flight's tree is linked to a tree of the inventory once and keeps the link, whatever the list says later: trees never
jump. Trees of one flight are never joined with each other, the detector has told them apart already. Flights are joined
once the pattern of their trees says how one lies on the other; until then each has trees of its own.
"""

from __future__ import annotations

import math
from dataclasses import replace

from schemas.trees import Tree, TreeList
from services.inventory.config import InventoryConfig, StartPoint
from services.inventory.geodesy import TangentPlane, place_of_start
from services.inventory.joining import Joiner
from services.inventory.merge import Spots, belief_of, fuse, partners
from services.inventory.values import (
    Belief,
    Changes,
    Contents,
    Flight,
    InventoryTree,
    Laid,
    Measurement,
    Rigid2,
    Sighting,
    Site,
)

_RAN_BACK_NS = 5_000_000_000
_WRITE_MOVE_M = 0.002
_WRITE_RADIUS_M = 0.0005
_WRITE_SIGMAS = 0.5
_FINE_EVERY_NS = 10_000_000_000
"""A tree that moved by less than half its doubt is no news, and is written this often only."""


class Inventory:
    """All flights, sightings and trees. ``take`` changes it; ``changes`` collects what to write until ``written``."""

    def __init__(self, config: InventoryConfig, contents: Contents | None = None) -> None:
        contents = contents or Contents()
        self._config = config
        self.sites = {site.number: site for site in contents.sites}
        self.flights = {flight.fid: flight for flight in contents.flights}
        self.trees = {tree.fid: tree for tree in contents.trees}
        # somebody may have deleted rows in QGIS: such a tree is entered anew when it is seen again
        self.sightings = {s.fid: s for s in contents.sightings if s.tree in self.trees and s.flight in self.flights}
        self.of_flight: dict[int, dict[int, Sighting]] = {fid: {} for fid in self.flights}
        self.of_tree: dict[int, dict[int, Sighting]] = {fid: {} for fid in self.trees}
        for sighting in self.sightings.values():
            self.of_flight[sighting.flight][sighting.tree_id] = sighting
            self.of_tree.setdefault(sighting.tree, {})[sighting.fid] = sighting
        self._next_tree = max([*self.trees, *(s.tree for s in contents.sightings)], default=0) + 1
        self._next_sighting = max((s.fid for s in contents.sightings), default=0) + 1
        self._fine_ns: dict[int, int] = {}
        self._joiner = Joiner(self, config)
        self.changes = Changes()

    def written(self) -> Changes:
        """Return what must be written and begin anew."""
        changes, self.changes = self.changes, Changes()
        return changes

    def join_next(self, now_ns: int) -> bool:
        """Try to lay one flight on one site; see ``Joiner``."""
        return self._joiner.join_next(now_ns)

    # -- flights

    def take(
        self, uav: str, trees: TreeList, now_ns: int, visited: frozenset[int] = frozenset(), *, in_air: bool = False
    ) -> Flight:
        """Take a flight's newest list. Older ones change nothing.

        Args:
            uav: the aircraft.
            trees: the list.
            now_ns: the time now, for the history.
            visited: ids that the aircraft has docked at.
            in_air: the map was begun in the air, so that it does not begin at the start point.
        """
        flight = self._flight(uav, trees, now_ns, in_air=in_air)
        if trees.stamp_ns < flight.stamp_ns:
            return flight
        flight.stamp_ns, flight.version, flight.last_ns = trees.stamp_ns, trees.version, now_ns
        self.changes.flights[flight.fid] = flight
        seen = self.of_flight[flight.fid]
        touched = self._withdraw(flight, trees)  # first: a trunk of this list may have had another id before
        self._link_new(flight, trees, now_ns)
        touched |= self._update(flight, trees, now_ns)
        for tree_id in visited & seen.keys():
            tree = self.trees[seen[tree_id].tree]
            if not tree.visited:
                tree.visited = True
                touched.add(tree.fid)
        for fid in sorted(touched):
            self.refresh(fid, now_ns)
        return flight

    def _flight(self, uav: str, trees: TreeList, now_ns: int, *, in_air: bool) -> Flight:
        """Return the flight of a list: known, or a new run when its time ran back (a simulation that began anew)."""
        same = [f for f in self.flights.values() if f.uav == uav and f.map_id == trees.map_id]
        newest = max(same, key=lambda f: f.run, default=None)
        if newest is not None and trees.stamp_ns > newest.stamp_ns - _RAN_BACK_NS:
            return newest
        fid = max(self.flights, default=0) + 1
        run = 1 if newest is None else newest.run + 1
        flight = self._new_flight(fid, uav, trees.map_id, run, now_ns, in_air=in_air)
        self.flights[fid] = self.changes.flights[fid] = flight
        self.of_flight[fid] = {}
        return flight

    def _new_flight(self, fid: int, uav: str, map_id: str, run: int, now_ns: int, *, in_air: bool) -> Flight:
        start = self._config.start_of(uav)
        if start is None or in_air:
            site = self._new_site("local")
            return Flight(fid, uav, map_id, run, "local", site.number, Rigid2(), 0.0, 0.0, aligned=False,
                          first_ns=now_ns, last_ns=now_ns, note=f"{'begun in the air' if in_air else 'no start point'}: local coordinates")  # fmt: skip
        site = next((s for s in self.sites.values() if s.frame == "global"), None) or self._new_site("global", start)
        plane = TangentPlane(site.latitude_deg, site.longitude_deg, site.altitude_m)
        place = place_of_start(plane, start.latitude_deg, start.longitude_deg, start.altitude_m, start.heading_deg)
        first = not any(f.site == site.number for f in self.flights.values())
        return Flight(fid, uav, map_id, run, "global", site.number, place, start.sigma_m,
                      math.radians(start.sigma_heading_deg), aligned=first, first_ns=now_ns, last_ns=now_ns,
                      note="first of its site" if first else "placed by its start point")  # fmt: skip

    def _new_site(self, frame: str, start: StartPoint | None = None) -> Site:
        number = max(self.sites, default=0) + 1
        if start is None:
            site = Site(number, "local")
        else:
            site = Site(number, "global", start.latitude_deg, start.longitude_deg, start.altitude_m)
        assert site.frame == frame
        self.sites[number] = self.changes.sites[number] = site
        return site

    def laid(self) -> dict[tuple[str, str], Laid]:
        """Return where the newest flight of each aircraft and map lies on the earth, for those that do.

        Flights laid on each other share the doubt of the site's first start point, which does not part them; one that
        only its own start point places has both doubts.
        """
        found: dict[tuple[str, str], Laid] = {}
        first = {f.site: f for f in sorted(self.flights.values(), key=lambda f: -f.fid) if f.frame == "global"}
        for flight in sorted(self.flights.values(), key=lambda f: f.run):
            site = self.sites[flight.site]
            if site.frame != "global":
                continue
            sigma_m, heading = flight.sigma_m, flight.sigma_heading_rad
            if flight is first[flight.site]:
                sigma_m = heading = 0.0
            elif not flight.aligned:
                sigma_m = math.hypot(sigma_m, first[flight.site].sigma_m)
                heading = math.hypot(heading, first[flight.site].sigma_heading_rad)
            at = (site.latitude_deg, site.longitude_deg, site.altitude_m)
            found[flight.uav, flight.map_id] = Laid(replace(flight.place), at, sigma_m, heading)
        return found

    # -- trees

    def _link_new(self, flight: Flight, trees: TreeList, now_ns: int) -> None:
        """Give each tree that is new to the flight a tree of the inventory: a known one where the flight lies on it.

        So too one that comes back when another of the list has its tree: the flight tells the two apart.
        """
        seen = self.of_flight[flight.fid]
        held = {s.tree for s in seen.values() if s.present}
        fresh: list[Tree] = []
        for tree in trees.trees:
            before = seen.get(tree.id)
            if before is None or (not before.present and before.tree in held):
                fresh.append(tree)
            else:
                held.add(before.tree)
        beliefs = [belief_of(tree) for tree in fresh]
        found: list[InventoryTree | None] = [None] * len(fresh)
        if fresh and (flight.aligned or self._precise(flight)):
            others = [t for t in self.trees.values() if t.site == flight.site and t.status != "merged" and t.fid not in held]  # fmt: skip
            found = partners(self.placed(flight, beliefs), [True] * len(fresh), others, self._config)
        for tree, belief, partner in zip(fresh, beliefs, found, strict=True):
            self._link(flight, tree.id, belief, partner.fid if partner is not None else self._new_tree(flight, now_ns))

    def _link(self, flight: Flight, tree_id: int, belief: Belief, fid: int) -> None:
        sighting = self.of_flight[flight.fid].get(tree_id)
        if sighting is None:
            sighting = Sighting(self._next_sighting, flight.fid, tree_id, fid, belief)
            self._next_sighting += 1
        else:
            del self.of_tree[sighting.tree][sighting.fid]
            sighting.tree = fid
        self.sightings[sighting.fid] = self.changes.sightings[sighting.fid] = sighting
        self.of_flight[flight.fid][tree_id] = sighting
        self.of_tree.setdefault(fid, {})[sighting.fid] = sighting

    def _precise(self, flight: Flight) -> bool:
        """Whether the start point alone is good enough to tell trunks apart, at 10 m from it."""
        reach = math.hypot(flight.sigma_m, 10.0 * flight.sigma_heading_rad)
        return flight.frame == "global" and 2.0 * reach < self._config.merge_m

    def placed(self, flight: Flight, beliefs: list[Belief]) -> Spots:
        """Return beliefs in the frame of the flight's site."""
        at = [flight.place.apply(b.x_m, b.y_m, b.z_m) for b in beliefs]
        return Spots.of([(x, y, b.radius_m, b.sigma_xy_m, b.sigma_radius_m)
                         for (x, y, _), b in zip(at, beliefs, strict=True)])  # fmt: skip

    def _new_tree(self, flight: Flight, now_ns: int) -> int:
        fid = self._next_tree
        self._next_tree += 1
        self.trees[fid] = InventoryTree(
            fid, flight.frame, flight.site, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, suitable=False,
            status="present", merged_into=None, first_ns=now_ns, last_ns=now_ns,
        )  # fmt: skip
        self.of_tree[fid] = {}
        return fid

    def _update(self, flight: Flight, trees: TreeList, now_ns: int) -> set[int]:
        """Take the new beliefs and keep those worth keeping in the history; return the trees they touch."""
        touched: set[int] = set()
        seen = self.of_flight[flight.fid]
        fine = now_ns - self._fine_ns.get(flight.fid, 0) >= _FINE_EVERY_NS
        if fine:
            self._fine_ns[flight.fid] = now_ns
        sigmas = 0.0 if fine else _WRITE_SIGMAS
        for tree in trees.trees:
            sighting = seen[tree.id]
            if self._no_news(sighting, tree, now_ns, sigmas):
                continue
            belief = belief_of(tree)
            if self._worth_keeping(sighting, belief, now_ns):
                self._keep(flight, sighting, belief, now_ns, trees.stamp_ns)
            sighting.belief, sighting.present = belief, True
            self.changes.sightings[sighting.fid] = sighting
            touched.add(sighting.tree)
        return touched

    def _no_news(self, sighting: Sighting, t: Tree, now_ns: int, sigmas: float) -> bool:
        """Whether a tree stands where it stood, within a part of its doubt: this runs for every tree of every list."""
        b = sighting.belief
        step_m = max(_WRITE_MOVE_M, sigmas * b.sigma_xy_m)
        return (
            sighting.present
            and sighting.kept is not None
            and abs(t.x_m - b.x_m) < step_m
            and abs(t.y_m - b.y_m) < step_m
            and abs(t.radius_m - b.radius_m) < max(_WRITE_RADIUS_M, sigmas * b.sigma_radius_m)
            and t.sigma_xy_m > 0.8 * b.sigma_xy_m
            and t.suitable == b.suitable
            and (t.observations <= b.observations or now_ns - sighting.kept_ns < self._config.history_every_s * 1e9)
        )

    def _worth_keeping(self, sighting: Sighting, now: Belief, now_ns: int) -> bool:
        kept, c = sighting.kept, self._config
        if kept is None or kept.suitable != now.suitable:
            return True
        step_m = max(c.history_move_m, _WRITE_SIGMAS * now.sigma_xy_m)
        if _moved(kept, now, step_m, max(c.history_radius_m, _WRITE_SIGMAS * now.sigma_radius_m)):
            return now_ns - sighting.kept_ns >= 1_000_000_000
        return now.observations > kept.observations and now_ns - sighting.kept_ns >= c.history_every_s * 1e9

    def _keep(self, flight: Flight, sighting: Sighting, belief: Belief, now_ns: int, stamp_ns: int) -> None:
        x, y, _ = flight.place.apply(belief.x_m, belief.y_m, belief.z_m)
        sighting.kept, sighting.kept_ns = belief, now_ns
        self.changes.measurements.append(Measurement(sighting.fid, sighting.tree, now_ns, stamp_ns, belief, x, y))

    def _withdraw(self, flight: Flight, trees: TreeList) -> set[int]:
        """Mark what the list no longer holds, and return it; a tree that no list holds any more stays, as withdrawn."""
        touched: set[int] = set()
        listed = {tree.id for tree in trees.trees}
        for tree_id, sighting in self.of_flight[flight.fid].items():
            if sighting.present and tree_id not in listed:
                sighting.present = False
                self.changes.sightings[sighting.fid] = sighting
                touched.add(sighting.tree)
        return touched

    def refresh(self, fid: int, now_ns: int) -> None:
        """Compute a tree anew from its flights' beliefs."""
        tree = self.trees[fid]
        if tree.status == "merged":
            return
        parts = list(self.of_tree[fid].values())
        present = [s for s in parts if s.present]
        tree.status = "present" if present else "withdrawn"
        used = present or list({s.flight: s for s in parts}.values())  # one of each flight
        placed = []
        for sighting in used:
            b = sighting.belief
            placed.append((b, self.flights[sighting.flight].place.apply(b.x_m, b.y_m, b.z_m)))
        f = fuse(placed)
        for name in f.__slots__:
            setattr(tree, name, getattr(f, name))
        tree.flights = len({s.flight for s in used})
        tree.last_ns = now_ns
        self.changes.trees[fid] = tree


def _moved(a: Belief, b: Belief, by_m: float, radius_m: float) -> bool:
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) >= by_m or abs(a.radius_m - b.radius_m) >= radius_m
