"""Slopes and leaks of long runs, on made-up samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.evaluate.bench_soak import _speeds
from services.evaluate.soak_figures import Sample, SharedFiles, faults_of, of_service, slope, steady


def samples(mb_per_h: float, files_per_h: float = 0.0, noise_mb: float = 0.3) -> list[Sample]:
    rng = np.random.default_rng(5)
    out = []
    for at_s in np.arange(10.0, 3600.0, 10.0):
        warm = 40.0 * (1.0 - np.exp(-at_s / 60.0))  # caches that fill in the first minutes
        rss = 100.0 + warm + mb_per_h * at_s / 3600.0 + rng.normal(0.0, noise_mb)
        out.append(Sample(float(at_s), "slam", 7, float(rss), 9, 20 + int(files_per_h * at_s / 3600.0)))
    return out


def test_a_flat_memory_is_called_flat_although_it_filled_at_first() -> None:
    figures = of_service(samples(0.0))
    assert abs(figures["mb_per_h"]) < 0.5
    assert faults_of(figures) == []


@pytest.mark.parametrize("minutes", [1, 3, 10, 19, 20, 30])
def test_caches_that_fill_are_no_leak_however_short_the_run(minutes: int) -> None:
    assert faults_of(of_service([s for s in samples(0.0) if s.at_s <= 60.0 * minutes])) == []


def test_the_speed_of_simulated_time_tells_what_gets_slower() -> None:
    rows: list[dict[str, Any]] = [{"at_s": 10.0 * k, "sim_s": 10.0 * k - 0.01 * k * k} for k in range(100)]
    slower = _speeds(rows)
    assert slower["speed"] == pytest.approx(0.9, abs=0.01)
    assert slower["speed_last_over_first"] < 0.9
    assert _speeds([{"at_s": 10.0 * k, "sim_s": 0.0} for k in range(5)]) == {}, "nothing is simulated"


def test_a_leak_is_found_with_its_size() -> None:
    figures = of_service(samples(12.0, files_per_h=8.0))
    assert figures["mb_per_h"] == pytest.approx(12.0, abs=0.5)
    assert [word.split(" ")[-1] for word in faults_of(figures)] == ["MB/h", "files"]


def test_what_levels_off_is_told_apart_from_what_goes_on() -> None:
    filling = [replace(s, rss_mb=100.0 + 3.0 * min(s.at_s / 2000.0, 1.0)) for s in samples(0.0)]
    assert of_service(filling)["mb_per_h"] > 1.0
    assert abs(of_service(filling)["mb_per_h_late"]) < 0.1
    assert of_service(samples(12.0))["mb_per_h_late"] == pytest.approx(12.0, abs=1.0)


def test_processor_time_is_that_of_the_life_that_was_last() -> None:
    busy = [replace(s, cpu_s=0.25 * s.at_s) for s in samples(0.0)]
    assert of_service(busy)["cores"] == pytest.approx(0.25, abs=0.001)
    busy[200:] = [replace(s, pid=8, cpu_s=0.5 * (s.at_s - 2000.0)) for s in busy[200:]]
    assert of_service(busy)["cores"] == pytest.approx(0.5, abs=0.001)


def test_a_restart_is_told() -> None:
    some = samples(0.0)
    some[200:] = [Sample(s.at_s, s.service, 8, s.rss_mb, s.threads, s.files) for s in some[200:]]
    assert "1 restarts" in faults_of(of_service(some))


def test_a_slope_knows_its_error() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 3600.0, 10.0)
    line = slope(list(t), list(50.0 + rng.normal(0.0, 1.0, len(t))))
    assert not line.rises
    assert 0.0 < line.error_per_hour < 2.0
    assert slope([0.0, 1.0], [1.0, 2.0]).error_per_hour == float("inf")


def test_the_spread_of_a_rate() -> None:
    assert steady([15.0] * 60) == 0.0
    assert steady([15.0] * 30 + [7.5] * 30) > 0.3
    assert steady([]) == float("inf")


def test_shared_memory_is_ours_by_who_had_it_and_left_until_the_file_is_gone(tmp_path: Path) -> None:
    for name in ("mine.zenoh", "later.zenoh", "another.zenoh"):
        (tmp_path / name).touch()
    line = "7f00-7f01 rw-s 00000000 00:1a 7 {}/{}\n7f02-7f03 r--p 0 08:01 9 /usr/lib/libc.so\n"
    shared = SharedFiles(tmp_path)
    assert shared.left([line.format(tmp_path, "mine.zenoh"), ""]) == 1
    assert shared.left([line.format(tmp_path, "later.zenoh")]) == 2, "whoever had the first is gone, its file is not"
    (tmp_path / "mine.zenoh").unlink()
    assert shared.left([]) == 1
