"""The catalogue, random scenes, truth and fairness."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from services.common.errors import InputError
from services.common.geometry import apply, inverse
from services.simulator.catalogue import CATALOGUE, HARD, KINDS, MULTI, SINGLE, random_scene, scene_by_name, scene_for
from services.simulator.path import map_frame, reference_path
from services.simulator.scene import Post, Scene, SceneTree
from services.simulator.touch import Touches
from services.simulator.truth import fair_trees, truth_trees
from services.simulator.world import World


def upright(x: float, y: float, radius: float) -> SceneTree:
    return SceneTree(x_m=x, y_m=y, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=radius, seed=1)


def test_catalogue_has_the_references_scenes() -> None:
    assert len(SINGLE) == 10
    assert len(MULTI) == 10
    assert [len(scene_by_name(name).suitable_trees) for name in SINGLE] == [1] * 10
    multi = [scene_by_name(name) for name in MULTI]
    assert sum(len(scene.suitable_trees) for scene in multi) == 22
    assert any(scene.tables for scene in multi)
    assert any(tree.radius_m == pytest.approx(0.4) and not tree.suitable for scene in multi for tree in scene.trees)
    assert {name.split("-")[1] for name in HARD} >= {"slope", "undergrowth", "close", "lean"}


def gaps(scene: Scene) -> list[float]:
    trees = scene.trees
    return [
        math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) - a.radius_m - b.radius_m
        for i, a in enumerate(trees)
        for b in trees[i + 1 :]
    ]


def test_three_trunks_stand_close_together() -> None:
    near = sorted(gaps(scene_by_name("multi-04")))[:2]
    assert all(0.15 <= gap <= 0.3 for gap in near)


def test_close_pairs_stand_half_a_metre_apart() -> None:
    trees = scene_by_name("hard-close-1").trees
    distances = [math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) for i, a in enumerate(trees) for b in trees[i + 1 :]]
    assert min(distances) == pytest.approx(0.5)


@pytest.mark.parametrize("name", ["single-01", "multi-04", "multi-06"])
def test_catalogue_trees_are_fair_and_the_path_keeps_clear(name: str) -> None:
    scene = scene_by_name(name)
    world = World(scene)
    path = reference_path(scene, None, world.clearance)
    assert path.target is not None
    assert all(fair for fair, tree in zip(fair_trees(world, path), scene.trees, strict=True) if tree.suitable)
    flying = np.arange(path.config.rest_s + 3.0, path.duration_s, 0.5)
    assert min(world.clearance(path.at(t)[:3, 3]) for t in flying) > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_random_scenes_repeat_and_differ(kind: str) -> None:
    scene = random_scene(5, kind)  # type: ignore[arg-type]
    assert scene == scene_by_name(scene.name)
    assert scene.trees != random_scene(6, kind).trees  # type: ignore[arg-type]
    assert scene.suitable_trees
    for tree in scene.trees:
        assert tree.z_m == pytest.approx(scene.ground.at(tree.x_m, tree.y_m))
        assert 1.5 < math.hypot(tree.x_m, tree.y_m) < 5.2


def test_scene_names() -> None:
    assert scene_for("random-mission", 7, 3) == random_scene(7, "mission", 3)
    assert scene_for("multi-02", 7).name == "multi-02"
    assert set(CATALOGUE) == {*SINGLE, *MULTI, *HARD}
    for name in ("multi-11", "random-desert-1", "random-multi-x", ""):
        with pytest.raises(InputError, match="unknown scene"):
            scene_by_name(name)


def test_what_is_suitable() -> None:
    tree = upright(3.0, 0.0, 0.1)
    assert tree.suitable
    assert not dataclasses.replace(tree, radius_m=0.21).suitable
    assert not dataclasses.replace(tree, radius_m=0.029).suitable
    assert not dataclasses.replace(tree, fork_height_m=0.9).suitable
    assert dataclasses.replace(tree, fork_height_m=1.5).suitable
    lean = math.radians(21.0)
    assert not dataclasses.replace(tree, axis=(math.sin(lean), 0.0, math.cos(lean))).suitable


def test_truth_is_told_in_the_map_frame() -> None:
    scene = dataclasses.replace(scene_by_name("multi-01"), start_yaw_rad=0.7)
    path = reference_path(scene)
    T_world_map = map_frame(path.at(0.0))
    truth = truth_trees(scene, T_world_map, [True] * len(scene.trees))
    first = path.at(0.0)
    assert np.allclose(apply(inverse(T_world_map), first[None, :3, 3]), 0.0)
    assert np.allclose((inverse(T_world_map) @ first)[:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    for tree, true in zip(scene.trees, truth, strict=True):
        back = apply(T_world_map, np.array([[true.x_m, true.y_m, true.z_m]]))[0]
        assert np.allclose(back, tree.base)
        assert true.radius_m == tree.radius_m


def test_a_hidden_a_thin_and_a_far_tree_are_not_fair() -> None:
    trees = (
        upright(3.0, 0.0, 0.1),
        upright(5.0, 0.0, 0.05),  # behind the first
        upright(0.0, 4.5, 0.031),  # 7 px wide
        upright(-7.5, 0.0, 0.15),  # beyond the sensor's range
        upright(0.0, -4.0, 0.1),
    )
    scene = Scene("made", 3, trees)
    world = World(scene)
    path = reference_path(scene, None, world.clearance)
    assert fair_trees(world, path) == (True, False, False, False, True)


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    scene = Scene("made", 3, (upright(3.0, 0.0, 0.1),), posts=(Post(0.0, 2.0, 0.05, 1.2),))
    world = World(scene)
    assert world.clearance(np.array([2.0, 0.0, 1.3])) == pytest.approx(0.9, abs=0.01)
    assert world.clearance(np.array([0.0, 1.0, 1.0])) == pytest.approx(0.95, abs=0.01)
    assert world.clearance(np.array([0.0, 0.0, 0.4])) == pytest.approx(0.4, abs=0.01)
    assert world.touches(np.array([2.75, 0.0, 1.3]), 0.25)
    assert not world.touches(np.array([2.5, 0.0, 1.3]), 0.25)


def test_touches_are_counted_from_take_off_on() -> None:
    touches = Touches(0.25)
    began = [touches.update(clearance) for clearance in (0.1, 0.1, 0.5, 1.0, 0.2, 0.1, 0.4, 0.24)]
    assert began == [False, False, False, False, True, False, False, True]
    assert touches.count == 2
    assert touches.smallest_m == 0.1
