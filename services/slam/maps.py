"""Which map slam works in: the one on disk, a new one, and when one is given up. Never silently: the map's name tells."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Protocol

from schemas.camera import Intrinsics
from services.slam.config import SlamConfig
from services.slam.keeper import Keeper, take_up
from services.slam.results import TrackResult
from services.slam.slam import Slam
from services.slam.store import Store
from services.slam.worker import Beside, Crew, Inline

LOG = logging.getLogger(__name__)

_ABOUT = "map"
_TELL_NS = 10_000_000_000
_PAUSE_NS = 1_000_000_000
"""Frames farther apart have a pause between them, in which nobody looked for a place."""


class Book(Protocol):
    """Where what has happened is told: the service's health."""

    def count(self, name: str) -> None:
        """Add one to a counter."""
        ...

    def note(self, topic: str, text: str) -> None:
        """Say what is wrong; an empty text withdraws it."""
        ...


class LockstepMap:
    """One map, mapped at once, nothing on disk: what ``process`` gives is a function of its input."""

    def __init__(self, config: SlamConfig) -> None:
        self._config = config

    def begin(self, intrinsics: Intrinsics, stamp_ns: int) -> Slam:
        """Return the map, named by its first frame."""
        return Slam(intrinsics, self._config, map_id=_name(stamp_ns), crew=Inline())

    def after(self, slam: Slam, result: TrackResult) -> Slam:
        """Return the map for the next frame: the same."""
        del result
        return slam

    def beat(self) -> None:
        """Nothing is kept."""

    def end(self) -> None:
        """Nothing runs."""


class LiveMaps:
    """One map after another, mapped by a thread beside tracking and kept in ``folder`` (None: not kept)."""

    def __init__(self, config: SlamConfig, folder: Path | None, health: Book) -> None:
        self._config = config
        self._health = health
        self.crew: Crew = Beside()
        self._store = None if folder is None else Store(folder, round(config.map_file_mb * 1e6))
        self._keeper: Keeper | None = None
        self._since_ns: int | None = None
        """Since when there is no pose, pauses left out."""
        self._stamp_ns: int | None = None
        """Of the last frame."""
        self._tell_until_ns = 0

    def begin(self, intrinsics: Intrinsics, stamp_ns: int) -> Slam:
        """Return the map on disk if it is ours and fresh, else a new one."""
        if self._store is None:
            return self._new(intrinsics, stamp_ns)
        slam = self._empty(intrinsics, _name(stamp_ns))
        why_not = take_up(self._store, slam, self._config.map_max_age_s)
        damaged = self._tell_damage(why_not, stamp_ns)
        if why_not:
            LOG.info("a new map is begun: %s", why_not)
            return self._new(intrinsics, stamp_ns)
        self._keeper = Keeper(self._store)
        self._keeper.resume(slam)
        self._since_ns = stamp_ns
        if not damaged:
            self._tell(f"slam was started again: looking for its place in {slam.map_id}")
        self._health.count("maps_taken_up")
        return slam

    def _tell_damage(self, why_not: str, stamp_ns: int) -> bool:
        """Tell for a while which files of the map were found damaged, and what became of it; return whether any was."""
        assert self._store is not None
        for path in self._store.damaged:
            after = "the map is left and a new one begun" if why_not else "the map is put together from its keyframes"
            text = f"{path}: is damaged; {after}"
            LOG.warning(text)
            self._health.count("bad_map_files")
            self._tell_until_ns = stamp_ns + _TELL_NS
            self._tell(text)
        return bool(self._store.damaged)

    def _empty(self, intrinsics: Intrinsics, map_id: str) -> Slam:
        return Slam(intrinsics, self._config, map_id=map_id, crew=self.crew, keep_trail=False)

    def _new(self, intrinsics: Intrinsics, stamp_ns: int) -> Slam:
        slam = self._empty(intrinsics, _name(stamp_ns))
        self._since_ns = None
        if self._store is not None:
            self._keeper = Keeper(self._store)
            self._keeper.begin(slam)
        self._health.count("maps_begun")
        return slam

    def after(self, slam: Slam, result: TrackResult) -> Slam:
        """Return the map for the next frame: another when this one has been of no use for too long."""
        pause_ns = 0 if self._stamp_ns is None else max(result.stamp_ns - self._stamp_ns - _PAUSE_NS, 0)
        self._stamp_ns = result.stamp_ns
        if result.status == "tracking":
            self._since_ns = None
            if self._tell_until_ns < result.stamp_ns:
                self._tell("")
        elif result.status in {"lost", "relocalising"}:
            self._since_ns = result.stamp_ns if self._since_ns is None else self._since_ns + pause_ns
            limit_s = self._config.new_map_after_s if result.status == "lost" else self._config.relocalise_within_s
            if result.stamp_ns - self._since_ns >= limit_s * 1e9:
                return self._give_up(slam, result, limit_s)
        if self._keeper is not None and self._keeper.fault:
            self._health.note("map on disk", self._keeper.fault)
        return slam

    def _give_up(self, slam: Slam, result: TrackResult, limit_s: float) -> Slam:
        if self._keeper is not None:
            self._keeper.let_go()
        fresh = self._new(slam.intrinsics, result.stamp_ns + 1)
        self._tell_until_ns = result.stamp_ns + _TELL_NS
        self._tell(f"no place found in {slam.map_id} for {limit_s:g} s: it is given up, {fresh.map_id} is begun")
        LOG.warning("no place found in %s for %g s: %s is begun", slam.map_id, limit_s, fresh.map_id)
        return fresh

    def _tell(self, text: str) -> None:
        self._health.note(_ABOUT, text)

    def beat(self) -> None:
        """Let the map on disk know, now and then, that slam lives."""
        if self._keeper is not None:
            self._keeper.beat()

    def end(self) -> None:
        """Stop in order: the map is over."""
        if self._keeper is not None:
            self._keeper.let_go()
        self.crew.close()
        if self._keeper is not None:
            self._keeper.end()


Maps = LockstepMap | LiveMaps


def _name(stamp_ns: int) -> str:
    return f"map-{stamp_ns}"
