"""filterpy without SciPy's statistics: a third of the refiner's start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CODE = """
import sys
from services.detector.refine.kalman import Filter1D
from services.detector.refine.filterpy_start import kalman_filter
f = Filter1D(1.0, 4.0, 1.0)
f.predict(0.1, 0.0, 0.0, 1.0)
f.update(2.0, 1.0)
assert 'scipy.stats' not in sys.modules, 'loaded at start'
likelihood = f._kalman.log_likelihood
import scipy.stats
from math import isclose
spread = float(f._kalman.S[0, 0])
assert isclose(likelihood, scipy.stats.norm.logpdf(float(f._kalman.y[0, 0]), 0.0, spread**0.5), rel_tol=1e-9)
assert scipy.stats.norm.cdf(0.0) == 0.5
assert kalman_filter() is type(f._kalman)
print('sound')
"""


def test_statistics_are_loaded_when_they_are_asked_for() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "sound", done.stderr
