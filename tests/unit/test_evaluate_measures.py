from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.simulation import TrueTree
from schemas.trees import Tree
from services.common.errors import InputError
from services.common.geometry import Matrix, exp_rotation, pose
from services.evaluate import bench_catalogue
from services.evaluate.ate import Trajectory, ate, read_trajectory, rigid_alignment
from services.evaluate.bench import BENCHES, BenchOptions, code_version, load_bench, replace_section
from services.evaluate.exports import trajectory_bytes, trees_json
from services.evaluate.trees import read_trees, score


def wander(count: int, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    poses = np.stack([pose(exp_rotation(rng.normal(size=3)), p) for p in positions])
    return Trajectory(np.arange(count, dtype=np.int64) * 10**7, poses)


def moved(T: Matrix, trajectory: Trajectory) -> Trajectory:
    return Trajectory(trajectory.stamps_ns + 3_000_000, np.stack([T @ p for p in trajectory.poses]))


def test_a_rigidly_moved_trajectory_has_no_error() -> None:
    truth = wander(50)
    T = pose(exp_rotation([0.3, -2.0, 1.0]), [4.0, 5.0, 6.0])
    error = ate(moved(T, truth), truth)
    assert error.rmse_m < 1e-9
    assert error.matched == 50
    assert error.rotation_deg_max < 1e-4


def test_ate_agrees_with_evo() -> None:
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    truth, estimate = wander(80, 1), moved(pose(exp_rotation([0.1, 0.2, 0.3]), [1.0, 0.0, 0.0]), wander(80, 1))
    estimate.poses[:, :3, 3] += np.random.default_rng(5).normal(scale=0.1, size=(80, 3))
    reference, other = PosePath3D(poses_se3=list(truth.poses)), PosePath3D(poses_se3=list(estimate.poses))
    other.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, other))
    assert ate(estimate, truth).rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)


def test_alignment_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.linalg.det(rigid_alignment(points, points * [1.0, 1.0, -1.0])[:3, :3]) == pytest.approx(1.0)


def test_too_few_matches_are_refused() -> None:
    with pytest.raises(InputError, match="at least 3"):
        ate(wander(2), wander(2))


def test_a_trajectory_is_read_as_it_was_written(tmp_path: Path) -> None:
    truth = wander(10)
    path = tmp_path / "t.txt"
    path.write_bytes(trajectory_bytes(zip(truth.stamps_ns.tolist(), truth.poses, strict=True)))
    again = read_trajectory(path)
    assert np.array_equal(again.stamps_ns, truth.stamps_ns)
    assert np.allclose(again.poses, truth.poses, atol=1e-6)
    path.write_text("1 0 0 0 0 0 0 0\n")
    with pytest.raises(InputError, match=r"t\.txt:1: the quaternion is zero"):
        read_trajectory(path)


def true_tree(x: float, y: float, radius: float = 0.1, *, suitable: bool = True, fair: bool = True) -> TrueTree:
    return TrueTree(x_m=x, y_m=y, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=radius, suitable=suitable, fair=fair)


def found_tree(identity: int, x: float, y: float, radius: float = 0.1, *, suitable: bool = True) -> Tree:
    return Tree(
        id=identity, x_m=x, y_m=y, z_m=0.0, axis=(0.0, 0.6, 0.8), radius_m=radius, radius_height_m=1.3, height_seen_m=2.0,
        sigma_xy_m=0.01, sigma_radius_m=0.01, arc_rad=1.0, confidence=1.0, observations=1, suitable=suitable,
    )  # fmt: skip


def test_trees_are_matched_one_to_one_nearest_first() -> None:
    truth = [true_tree(0, 0), true_tree(0.4, 0), true_tree(9, 9), true_tree(5, 5, fair=False)]
    truth.append(true_tree(3, 0, 0.4, suitable=False))
    found = [found_tree(1, 0.15, 0), found_tree(2, 0.25, 0), found_tree(3, 3, 0), found_tree(4, 8, 0, suitable=False)]
    result = score(found, truth)
    assert [(m.true.x_m, m.found.id) for m in result.matches] == [(0, 1), (0.4, 2)]
    assert [t.x_m for t in result.missed] == [9]
    assert [t.x_m for t in result.hidden] == [5]
    assert [t.id for t in result.false] == [3]
    assert result.suitable == 4
    assert result.matches[0].centre_error_m == pytest.approx(0.15)


def test_a_tree_of_a_wrong_radius_is_missed_and_false() -> None:
    result = score([found_tree(1, 0, 0, 0.19)], [true_tree(0, 0, 0.1)])
    assert (len(result.matches), len(result.missed), len(result.false)) == (0, 1, 1)


def test_trees_json_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "trees.json"
    path.write_bytes(trees_json([found_tree(1, 2.0, 3.0)], "map"))
    assert read_trees(path)[0].x_m == 2.0
    path.write_text("[]")
    with pytest.raises(InputError, match=r"trees\.json: not a trees\.json"):
        read_trees(path)


def row(name: str, **more: object) -> dict[str, object]:
    return {
        "scene": name, "suitable": 1, "found": 1, "centre_errors_m": [0.03], "radius_errors_m": [0.01], "missed": [],
        "hidden": [], "false": [], "frames": 10, "tracked": 10, "process_s": 1.0, "frame_ms": 5.0, **more,
    }  # fmt: skip


def test_the_catalogue_resumes_and_redoes_a_torn_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def fake(name: str, *_: object, **__: object) -> dict[str, object]:
        done.append(name)
        bad = {"false": [{"x_m": 1.0, "y_m": 2.0, "radius_m": 0.1}]} if name == "multi-02" else {}
        return row(name, **bad)

    monkeypatch.setattr(bench_catalogue, "run_scene", fake)
    options = BenchOptions(out=tmp_path, scenes=("single-01", "multi-02"))
    first = bench_catalogue.run(options)
    assert done == ["single-01", "multi-02"]
    again = bench_catalogue.run(options)
    assert done == ["single-01", "multi-02"]
    assert again.table == first.table
    assert first.figures == {
        "scenes": 2, "suitable": 2, "found": 2, "false": 1, "missed": 0, "centre_rmse_m": 0.03, "radius_rmse_m": 0.01,
    }  # fmt: skip
    assert "multi-02: 1/1 found, 1 false" in first.table
    assert "false (+1.00 +2.00) r 10.0 cm" in first.table
    store = tmp_path / "catalogue.jsonl"
    store.write_text(store.read_text()[:-30])
    assert bench_catalogue.run(options).figures == first.figures
    assert done == ["single-01", "multi-02", "multi-02"]
    assert bench_catalogue.run(options).figures == first.figures
    assert len(done) == 3


def test_a_seed_gives_fresh_scenes_and_the_default_the_references_twenty() -> None:
    named = bench_catalogue.scene_names(BenchOptions())
    assert len(named) == 20
    fresh, other = (bench_catalogue.scene_names(BenchOptions(seed=seed)) for seed in (1, 2))
    assert len(set(fresh)) == 20
    assert not set(fresh) & (set(other) | set(named))


def test_an_unknown_benchmark_is_refused_with_the_names() -> None:
    with pytest.raises(InputError, match="catalogue"):
        load_bench("nonsense")
    assert callable(load_bench("catalogue"))
    assert all(module.startswith("services.evaluate.bench_") for module in BENCHES.values())


def test_the_code_version_changes_with_the_package() -> None:
    assert code_version(("schemas",)) == code_version(("schemas",)) != code_version(("services.camera",))


def test_a_section_is_replaced_in_place() -> None:
    text = replace_section("# B\n", "a", "one")
    text = replace_section(text, "b", "two")
    text = replace_section(text, "a", "three\nlines")
    assert text == "# B\n\n## a\n\nthree\nlines\n\n## b\n\ntwo\n"


def test_bench_json_ends_with_one_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from services.cli.bench import bench

    monkeypatch.setattr(bench_catalogue, "run_scene", lambda name, *_, **__: row(name))
    monkeypatch.setattr(
        sys, "argv", ["treedock", "bench", "catalogue", "--out", str(tmp_path), "--data=there", "--json"]
    )
    bench("catalogue", out=tmp_path, scenes="single-01", doc=tmp_path / "b.md", as_json=True)
    printed = capsys.readouterr()
    assert json.loads(printed.out)["bench"] == "catalogue"
    assert "machine" in printed.err
    section = "## catalogue\n\n`treedock bench catalogue --json`\n"  # without this machine's folders
    assert section in (tmp_path / "b.md").read_text()


@pytest.mark.parametrize("keep", [True, False])
def test_rendered_scenes_are_kept_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: bool) -> None:
    from services.simulator import write

    rendered: list[Path] = []

    def fake(_: object, folder: Path, **__: object) -> None:
        rendered.append(folder)
        folder.mkdir()
        (folder / "rgb.txt").write_text("x")

    monkeypatch.setattr(write, "write_sequence", fake)
    options = BenchOptions(out=tmp_path, keep_sequences=keep)
    for _ in range(2):
        with bench_catalogue._rendered("single-01", options) as folder:
            assert (folder / "rgb.txt").exists()
    assert len(rendered) == (1 if keep else 2)
    assert len(list((tmp_path / "sequences").iterdir())) == int(keep)
