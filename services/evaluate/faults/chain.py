"""The real camera, slam, mapper, detector and refiner over a recording that goes on and on, and somebody who harms them.

The recording is a rendered scene, shown forwards and backwards at its own rate, stamped by this machine's clock: what a
camera on a stand sees that turns and walks the same way again and again. So what is known of the trees before a fault can be
asked for again after it.
"""

from __future__ import annotations

import itertools
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from schemas.camera import RgbdFrame
from schemas.mapping import MapIndex
from schemas.slam import Pose
from schemas.topics import MAP_INDEX, SIM_RGBD, SLAM_POSE
from schemas.trees import TreeList
from services.common.errors import InputError
from services.common.session import free_port
from services.evaluate.bench import BenchOptions
from services.evaluate.faults.rig import Comeback, Rig
from services.evaluate.live_set import frames_for, live_config

SERVICES = ("router", "camera", "slam", "mapper", "detector", "refiner")
_RATE_HZ = 15.0
_SAME_M = 0.05
_READY_WITHIN_S = 300.0
_SEEN_WITHIN_S = 90.0
_MOST_SUBMAPS, _SAVED_WITHIN_S = 0.9, 15.0
"""What the mapper took up since it saved last, every 10 s, goes with it."""
_STAYS_S = 6.0
"""Longer than the mapper takes to tell what it holds, twice, and the detector to draw its conclusions."""


@dataclass
class Chain:
    """The services, fed. Use as a context manager; ``pump`` of the rig feeds too."""

    rig: Rig
    frames: Sequence[RgbdFrame]
    poses: list[Pose] = field(default_factory=list)
    held: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=1000))
    """When the mapper told what it holds, and how many submaps."""

    @classmethod
    def over_a_recording(cls, seed: int | None, folder: Path, tell: Callable[[str], None]) -> Chain:
        """Render a scene of ``seed``, the named one without (or take up what was rendered), and make the chain over it."""
        options = BenchOptions(seed=seed, out=folder.parent / "treedock-faults-recordings", tell=tell)
        _, frames = frames_for(options)
        config = live_config(folder / "chain")
        # never the usual port: others' services would join
        config = config.model_copy(
            update={"router": config.router.model_copy(update={"port": free_port(config.router.host)})}
        )
        return cls(Rig(config, folder / "chain", SERVICES, standins=frozenset()), frames)

    def __enter__(self) -> Self:
        self._there_and_back: Iterator[RgbdFrame] = itertools.cycle([*self.frames, *reversed(self.frames)])
        self._seq, self._due_s = 0, time.monotonic()
        self.rig.__enter__()
        try:
            self._begin()
        except BaseException:  # nobody has it yet who would end it
            self.rig.__exit__()
            raise
        return self

    def _begin(self) -> None:
        """Wait until all are ready, and until the recording has shown its trees."""
        self.rig.bus.subscribe(SLAM_POSE, self._on_pose)
        self.rig.bus.subscribe(MAP_INDEX, self._on_index)
        if not self.rig.until(lambda: self.rig.all_ready, _READY_WITHIN_S):
            raise InputError(f"not ready within {_READY_WITHIN_S:.0f} s: see {self.rig.folder}")
        self.rig.each = self._feed
        self._due_s = time.monotonic()
        self.rig.pump(2.0 * len(self.frames) / _RATE_HZ + 5.0)  # once there and back: all trees are known
        if not self.rig.until(lambda: self.trees is not None, _SEEN_WITHIN_S):
            raise InputError("the recording shows no tree: another --seed")

    def __exit__(self, *_: object) -> None:
        self.rig.__exit__()

    def _feed(self) -> None:
        """Send the frame that is due; one that is late is sent at once, and the next in its turn."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = max(self._due_s + 1.0 / _RATE_HZ, now_s - 0.5 / _RATE_HZ)
        stamp_ns = time.time_ns()
        self.rig.bus.publish(SIM_RGBD, replace(next(self._there_and_back), stamp_ns=stamp_ns, seq=self._seq))
        self._seq += 1

    def _on_pose(self, pose: Pose) -> None:
        self.poses.append(pose)
        del self.poses[:-2000]

    def _on_index(self, index: MapIndex) -> None:
        self.held.append((time.monotonic(), len(index.submap_ids)))

    @property
    def submaps(self) -> int:
        """Return how many submaps the mapper held when it must last have saved them."""
        saved_s = time.monotonic() - _SAVED_WITHIN_S
        return next((count for at_s, count in reversed(self.held) if at_s <= saved_s), 0)

    @property
    def trees(self) -> TreeList | None:
        """The list, None while it is empty."""
        found = self.rig.flown.trees
        return found if found is not None and found.trees else None

    def located_since(self, count: int) -> int:
        """Return how many of the poses after the first ``count`` are known."""
        return sum(p.T_map_camera is not None for p in self.poses[count:])

    def harm(
        self, service: str, number: int = signal.SIGKILL, patience_s: float = 60.0,
        before_restart: Callable[[], None] = lambda: None,
    ) -> Comeback | None:  # fmt: skip
        """Send a signal and wait for the service's return; ``before_restart`` is done to it while it is dead."""
        pid, at_s = self.rig.harm(service, number)
        before_restart()  # the supervisor looks again only when this is done
        return self.rig.comeback(service, pid, at_s, patience_s)

    def known(self) -> TreeList:
        """Return the list, waited for: what was lost in a fault before may still be on its way.

        Raises:
            InputError: there is none.
        """
        self.rig.until(lambda: self.trees is not None, _SEEN_WITHIN_S)
        found = self.trees
        if found is None:
            raise InputError(f"no tree in the list for {_SEEN_WITHIN_S:.0f} s: see {self.rig.folder}")
        return found

    def whole_again(self, before: TreeList, since_ns: int, *, submaps: int = 0, anew: bool = False) -> list[str]:
        """Wait until poses come and every tree known before is known again, and stays; return what is missing.

        A list of the poses' own map, and still so after some seconds: the last one stands until somebody says otherwise. So the mapper
        must have told by then that it holds ``submaps`` (nearly: some are thinned). ``anew``: it may be another map.
        """
        self.poses.clear()
        asked_s = time.monotonic()
        end_s = asked_s + _SEEN_WITHIN_S
        missing = [tree.id for tree in before.trees]
        least = int(_MOST_SUBMAPS * submaps)

        def mapped() -> bool:
            return bool(self.held) and self.held[-1][0] > asked_s and self.held[-1][1] >= least

        def whole() -> bool:
            nonlocal missing
            now = self.trees
            missing = (
                lost(before, now, anew=anew)
                if now is not None and now.stamp_ns >= since_ns
                else [t.id for t in before.trees]
            )
            ours = now is not None and bool(self.poses) and now.map_id == self.poses[-1].map_id
            return ours and not missing and self.located_since(0) >= 15 and mapped()

        while self.rig.until(whole, max(0.0, end_s - time.monotonic())):
            self.rig.pump(_STAYS_S)
            if whole():
                return []
        words = [f"tree {number} is lost" for number in missing]
        words += [f"the mapper holds {self.held[-1][1] if self.held else 0} submaps of {submaps}"] * (not mapped())
        words += ["slam began another map"] * (not anew and bool(self.poses) and self.poses[-1].map_id != before.map_id)
        return words + ["no pose any more"] * (self.located_since(0) < 15)


def lost(before: TreeList, now: TreeList, *, anew: bool = False) -> list[int]:
    """Return the trees of ``before`` that stand under their id within 5 cm no more; in a new map, where that may be, any may have moved."""
    if now.map_id != before.map_id:
        if not anew:
            return [t.id for t in before.trees]
        return [] if len(now.trees) >= len(before.trees) else [t.id for t in before.trees[len(now.trees) :]]
    places = {t.id: (t.x_m, t.y_m) for t in now.trees}
    return [
        t.id for t in before.trees
        if t.id not in places or np.hypot(places[t.id][0] - t.x_m, places[t.id][1] - t.y_m) > _SAME_M
    ]  # fmt: skip
