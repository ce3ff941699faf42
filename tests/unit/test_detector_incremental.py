from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.detector import incremental
from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.incremental import Incremental, cells_of
from services.detector.model import DetectionResult, Views
from tests.unit.detector_clouds import facing, ground, trunk
from tests.unit.detector_world import EYE, System, moved, submap_of

Points = NDArray[np.float32]

PLACES = ((-3.0, -3.0), (-3.0, 3.0), (3.0, -3.0), (3.0, 3.0))


def _map(places: tuple[tuple[float, float], ...]) -> Points:
    rng = np.random.default_rng(3)
    return np.concatenate([ground(7.0), *(trunk(x, y, 0.12, rng, arc=facing(x, y)) for x, y in places)]).astype(
        np.float32
    )


def _views(cloud: Points) -> Views:
    return Views(np.zeros(len(cloud), dtype=np.int32), np.array([[0.0, 0.0, 1.5]]))


def _places(result: DetectionResult) -> list[tuple[int, int]]:
    return sorted((round(t.base_m[0]), round(t.base_m[1])) for t in result.trunks)


def test_only_touched_cells_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    real = detect_trees

    def counted(points: Points, *rest: object) -> DetectionResult:
        seen.append(len(points))
        return real(points, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(incremental, "detect_trees", counted)
    detector = Incremental(DetectorConfig())
    before = _map(PLACES[:3])
    assert _places(detector.update(before, _views(before), frozenset())) == sorted(
        (round(x), round(y)) for x, y in PLACES[:3]
    )
    after = _map((*PLACES[1:3], (2.0, 2.0)))  # one is gone, one is new
    rng = np.random.default_rng(3)
    touched = cells_of(trunk(-3.0, -3.0, 0.12, rng)) | cells_of(trunk(2.0, 2.0, 0.12, rng))
    assert _places(detector.update(after, _views(after), touched)) == [(-3, 3), (2, 2), (3, -3)]
    assert seen[1] < 0.5 * seen[0]
    assert bool(detector.partial)
    kept = {t.base_m for t in detector.result.trunks} if detector.result else set()
    assert _places(detector.whole(after, _views(after))) == [(-3, 3), (2, 2), (3, -3)]
    assert not bool(detector.partial)
    assert detector.result is not None
    for t in detector.result.trunks:
        assert min(np.hypot(t.base_m[0] - k[0], t.base_m[1] - k[1]) for k in kept) < 0.01


def test_a_change_nearly_everywhere_is_a_look_at_the_whole() -> None:
    detector = Incremental(DetectorConfig())
    cloud = _map(PLACES)
    detector.update(cloud, _views(cloud), frozenset())
    detector.update(cloud, _views(cloud), cells_of(cloud))
    assert not detector.partial


def test_ids_live_through_parts_and_a_map_correction() -> None:
    system = System()
    near, far = (_map(places).astype(np.float64) for places in (PLACES[:2], PLACES[2:]))
    system.send(submap_of(near[near[:, 0] < 0.0], 1), submap_of(far[far[:, 0] > 0.0], 2))
    names = {t.id: (round(t.x_m), round(t.y_m)) for t in system.lists[-1].trees}
    assert sorted(names.values()) == sorted((round(x), round(y)) for x, y in PLACES)
    shifted = EYE.copy()
    shifted[0, 3] += 0.3
    system.send(moved(submap_of(far[far[:, 0] > 0.0], 2), shifted))  # a loop closes: half of the map moves
    after = {t.id: t.x_m for t in system.lists[-1].trees}
    assert after.keys() == names.keys()
    for tree_id, (x, _) in names.items():
        assert after[tree_id] == pytest.approx(x + (0.3 if x > 0 else 0.0), abs=0.03)
    system.hub.advance_to(system.hub.clock.now_ns() + 4_000_000_000)
    assert not system.detector._incremental.partial, "when nothing comes, the whole is looked at"
