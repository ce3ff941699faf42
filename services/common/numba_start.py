"""Load numba faster: without SciPy's linear algebra, of which it wants one small module."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

_PACKAGE = "scipy.linalg"


def load_numba() -> None:
    """Load numba's own machinery. To be called before the first kernel is; a second call does nothing.

    numba looks once whether there is a BLAS by importing ``scipy.linalg.cython_blas``, for which Python loads the whole
    of ``scipy.linalg`` (0.1 s). Here an empty package stands in for it meanwhile: the module itself is the real one, and
    who imports ``scipy.linalg`` later gets all of it.
    """
    import numba
    import scipy

    del numba
    if _PACKAGE in sys.modules:
        return
    stand_in = ModuleType(_PACKAGE)
    stand_in.__path__ = [str(Path(folder) / "linalg") for folder in scipy.__path__]
    sys.modules[_PACKAGE] = stand_in
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_PACKAGE]
