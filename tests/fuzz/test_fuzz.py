"""Whatever bytes come from outside, each reader gives a value or its own error: never another, never a crash.

25 cases a target here; ``TREEDOCK_FUZZ=20000 pytest tests/fuzz`` for many (docs/threat-model.md says how many were run).
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.damage import CASES, damaged
from tests.fuzz.targets import TARGETS


@pytest.mark.timeout(0 if CASES > 1000 else 300)
@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_give_a_value_or_the_readers_own_error(name: str) -> None:
    target = TARGETS[name]
    for seed in target.seeds:
        with tempfile.TemporaryDirectory() as folder:
            target.read(seed, Path(folder))  # the undamaged one is read

    @settings(max_examples=max(1, CASES // target.slow), deadline=None, suppress_health_check=list(HealthCheck))
    @given(damaged(target.seeds))
    def survives(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a warning about bad bytes is an answer
            try:
                target.read(data, Path(folder))
            except target.answers:
                return

    survives()
