"""Trees keep their ids when the detector is killed and starts again in the same map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from schemas.mapping import Submap
from schemas.topics import TREES_LIST
from schemas.trees import TreeList
from services.common.geometry import inverse, level_camera
from services.detector import names
from services.detector.names import pack, unpack
from tests.unit.detector_clouds import Floats, facing, ground, trunk
from tests.unit.detector_world import EYE, System, submap_of

FAR, NEAR, BESIDE = (4.0, -1.5), (2.5, 0.9), (3.2, -0.4)
Places = dict[int, tuple[float, float]]


def tree_cloud(place: tuple[float, float], seed: int = 1) -> Floats:
    return trunk(*place, 0.10, np.random.default_rng(seed), arc=facing(*place))


def first_run(folder: Path) -> tuple[list[Submap], TreeList]:
    """The far tree is found before the near one, as in a flight: detection itself lists the near one first."""
    system = System(str(folder))
    one = submap_of(np.concatenate([ground(5.0), tree_cloud(FAR)]), 1)
    two = submap_of(tree_cloud(NEAR), 2)
    system.send(one)
    system.send(two)
    last = system.lists[-1]
    assert places(last) == {1: FAR, 2: NEAR}
    return [one, two], last


def places(told: TreeList) -> Places:
    return {t.id: (round(t.x_m, 1), round(t.y_m, 1)) for t in told.trees}


def started_again(folder: Path, *submaps: Submap, index: bool = True) -> System:
    """A new detector finds a mapper that has ``submaps`` (the last run was killed: it said no last words)."""
    system = System(str(folder), now_ns=9_000_000_000)
    system.whole = list(submaps)
    system.send(submaps[-1])
    if index:
        system.tell_index(*submaps)
    return system


def test_ids_stay_over_a_kill(tmp_path: Path) -> None:
    submaps, before = first_run(tmp_path)
    system = started_again(tmp_path, *submaps)
    assert [places(told) for told in system.lists] == [{1: FAR, 2: NEAR}]
    assert system.lists[0].version > before.version
    assert [t.observations for t in system.lists[0].trees] == [t.observations + 1 for t in before.trees]
    third = submap_of(tree_cloud(BESIDE), 3)
    system.send(third)
    assert places(system.lists[-1]) == {1: FAR, 2: NEAR, 3: BESIDE}
    again = started_again(tmp_path, *submaps, third)
    assert places(again.lists[-1]) == {1: FAR, 2: NEAR, 3: BESIDE}


def test_nothing_is_said_of_half_a_map(tmp_path: Path) -> None:
    submaps, _ = first_run(tmp_path)
    system = System(str(tmp_path), now_ns=9_000_000_000)
    system.send(submaps[0])  # the mapper does not answer yet
    system.rest(20.0)
    assert system.lists == []
    system.whole = submaps
    system.tell_index(*submaps)
    assert [places(told) for told in system.lists] == [{1: FAR, 2: NEAR}]


def test_half_a_map_that_stays_half_is_not_waited_for_for_ever(tmp_path: Path) -> None:
    submaps, _ = first_run(tmp_path)
    system = System(str(tmp_path), now_ns=9_000_000_000)
    system.send(submaps[0])
    system.rest(31.0)
    assert places(system.lists[-1]) == {1: FAR, 2: NEAR}
    for number, place in enumerate((BESIDE, (3.0, 2.2), (4.5, 0.5), (4.5, 1.8))):
        system.send(submap_of(tree_cloud(place), 3 + number))
    assert places(system.lists[-1])[2] == NEAR, "not withdrawn by looks at a part of the map"
    assert places(system.lists[-1])[3] == BESIDE, "the id of the tree that is not there is not given to another"
    held = [submaps[0], *(submap_of(tree_cloud(BESIDE), 3 + number) for number in range(4))]
    system.tell_index(*held)  # the map is whole, and has it no more
    for version in range(2, 6):
        system.send(submap_of(tree_cloud(BESIDE), 3, version))
    assert 2 not in places(system.lists[-1])


def test_a_mapper_that_starts_again_takes_no_tree_away(tmp_path: Path) -> None:
    """On a busy machine it answers late: for a while the detector holds nothing of the map."""
    submaps, _ = first_run(tmp_path)
    system = started_again(tmp_path, *submaps)
    count = len(system.lists)
    system.whole = []
    system.tell_index(*submaps, epoch=2)
    system.send(submaps[1])
    system.rest(10.0)
    assert len(system.lists) == count
    assert "trees_gone" not in system.detector._context.health.counters
    system.whole = submaps
    system.tell_index(*submaps, epoch=2)
    system.send(submap_of(tree_cloud(BESIDE), 3))
    assert places(system.lists[-1]) == {1: FAR, 2: NEAR, 3: BESIDE}


def test_a_mapper_that_lost_its_map_takes_no_tree_away_that_it_does_not_look_at(tmp_path: Path) -> None:
    submaps, _ = first_run(tmp_path)
    system = started_again(tmp_path, *submaps)
    looks = level_camera([0.0, 0.0, 1.5], float(np.arctan2(FAR[1], FAR[0])))
    fresh = submap_of(tree_cloud(FAR), 8, T=looks, graph_version=4)
    system.whole = [fresh]
    system.tell_index(fresh, epoch=2, graph_version=4)
    system.rest(31.0)
    for version in range(2, 8):
        system.send(submap_of(tree_cloud(FAR), 8, version, T=looks, graph_version=4))
    assert places(system.lists[-1]) == {1: FAR, 2: NEAR}
    for version in range(1, 7):
        system.send(submap_of(np.concatenate([ground(5.0), tree_cloud(FAR)]), 9, version, graph_version=5))
    assert places(system.lists[-1]) == {1: FAR}, "where the map shows none, there is none"


@pytest.mark.parametrize("way_m", [0.6, -0.6])
def test_ids_follow_corrections_made_meanwhile(tmp_path: Path, way_m: float) -> None:
    """Trees 0.6 m apart in a map that is moved by 0.6 m: each comes to stand where another was."""
    system = System(str(tmp_path))
    clouds = [tree_cloud((4.0, y)) for y in (0.0, 0.6, 1.2)]
    submap = submap_of(np.concatenate([ground(5.0), *clouds]))
    system.send(submap)
    before = system.lists[-1]
    assert len(before.trees) == 3
    T = level_camera([0.0, way_m, 1.5], 0.0)
    whole = submap_of(np.concatenate([ground(5.0), *clouds]) + np.array([0.0, way_m, 0.0]), T=T, graph_version=4)
    again = started_again(tmp_path, whole)
    after = {t.id: t for t in again.lists[-1].trees}
    assert after.keys() == {t.id for t in before.trees}
    for tree in before.trees:
        x, y, _ = (T @ inverse(EYE) @ [tree.x_m, tree.y_m, tree.z_m, 1.0])[:3]
        assert (after[tree.id].x_m, after[tree.id].y_m) == pytest.approx((x, y), abs=0.03)


def test_a_place_that_nothing_leads_to_gives_no_name(tmp_path: Path) -> None:
    """The mapper lost its map and slam's has changed: which of the trunks is which cannot be told, so all are new."""
    submaps, _ = first_run(tmp_path)
    fresh = submap_of(np.concatenate([ground(5.0), tree_cloud(FAR), tree_cloud(NEAR)]), 7, graph_version=9)
    system = started_again(tmp_path, fresh)
    system.rest(31.0)
    assert sorted(places(system.lists[-1])) == [3, 4]
    assert len(submaps) == 2


def test_an_older_graph_under_the_same_name_is_another_map(tmp_path: Path) -> None:
    submaps, _ = first_run(tmp_path)
    system = started_again(tmp_path, *(submap_of(_placed(s), s.submap_id, graph_version=1) for s in submaps))
    assert sorted(places(system.lists[-1])) == [3, 4]


def _placed(submap: Submap) -> Floats:
    T = submap.T_map_submap
    return submap.points_m @ T[:3, :3].T + T[:3, 3]


def test_another_map_or_boot_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    submaps, _ = first_run(tmp_path)
    other = System(str(tmp_path), now_ns=9_000_000_000)
    other.send(submap_of(_placed(submaps[0]), map_id="m2"))
    assert sorted(places(other.lists[-1])) == [3], "at once, and no id is used again"
    monkeypatch.setattr(names, "boot_id", lambda: "tomorrow")
    later = System(str(tmp_path), now_ns=9_000_000_000)
    later.send(submap_of(_placed(submaps[0]), map_id="m2"))
    assert sorted(places(later.lists[-1])) == [1]


def test_a_stop_in_order_keeps_them_as_well(tmp_path: Path) -> None:
    submaps, before = first_run(tmp_path)
    system = started_again(tmp_path, *submaps)
    system.hub.stop()
    kept = unpack((tmp_path / "trees-uav1.ids").read_bytes())
    assert [t.id for t in kept.trees] == [t.id for t in before.trees]
    idle = System(str(tmp_path))
    idle.hub.stop()
    assert unpack((tmp_path / "trees-uav1.ids").read_bytes()) == kept, "who has seen no map forgets nothing"


def test_the_file_is_there_before_the_list_and_is_not_written_for_every_list(tmp_path: Path) -> None:
    system, file = System(str(tmp_path)), tmp_path / "trees-uav1.ids"
    kept: list[bool] = []

    def compare(told: TreeList) -> None:
        kept.append([t.id for t in unpack(file.read_bytes()).trees] == [t.id for t in told.trees])

    system.hub.context("preview").on(TREES_LIST, compare)
    cloud = np.concatenate([ground(5.0), tree_cloud(FAR)])
    for tick in range(20):  # it moves all the time, for ten seconds
        system.send(submap_of(cloud + np.array([0.004 * tick, 0.0, 0.0]), version=tick + 1))
    assert len(kept) == 20
    assert all(kept)
    assert system.detector._context.health.counters["tree_ids_saved"] <= 11


def test_a_disk_that_refuses_costs_only_this(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    system = System(str(tmp_path / "file"))
    cloud = np.concatenate([ground(5.0), tree_cloud(FAR)])
    for tick in range(20):
        system.send(submap_of(cloud + np.array([0.004 * tick, 0.0, 0.0]), version=tick + 1))
    health = system.detector._context.health
    assert len(system.lists) == 20
    assert 1 <= health.counters["tree_id_save_errors"] <= 3
    assert "trees-uav1.ids: cannot be " in health.notes["tree_id file"]
    assert "the numbering of trees would not survive a restart" in health.notes["tree_id file"]


def test_a_damaged_file_is_set_aside_and_told(tmp_path: Path) -> None:
    submaps, _ = first_run(tmp_path)
    file = tmp_path / "trees-uav1.ids"
    whole = file.read_bytes()
    for damaged in (whole[:-9], whole[:20], b"", whole.replace(b'"id":1', b'"id":2', 1), b"noise" * 100):
        file.write_bytes(damaged)
        system = started_again(tmp_path, *submaps)
        health = system.detector._context.health
        assert health.counters["bad_tree_id_files"] == 1
        assert (tmp_path / "trees-uav1.ids.bad").read_bytes() == damaged
        assert sorted(places(system.lists[-1])) == [1, 2]
        assert "tree_id file" not in health.notes, "a good one was written since"


def test_a_file_of_another_format_names_what_is_wrong(tmp_path: Path) -> None:
    first_run(tmp_path)
    names = unpack((tmp_path / "trees-uav1.ids").read_bytes())
    with pytest.raises(ValueError, match="is not understood: format"):
        unpack(pack(names.model_copy(update={"format": 2})))
