"""Load filterpy faster: without SciPy's statistics, of which a Kalman filter needs nothing until it is asked for a likelihood."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

_PACKAGE = "scipy.stats"


class _Later:
    """Stands for a distribution: the first use after the import loads the real one."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:  # noqa: ANN401
        if isinstance(sys.modules.get(_PACKAGE), _StandIn):
            return _nothing  # filterpy tries once, while it is imported, which arguments SciPy takes
        return getattr(getattr(importlib.import_module(_PACKAGE), self._name), attribute)


class _StandIn(ModuleType):
    """An empty ``scipy.stats``."""

    norm = _Later("norm")
    multivariate_normal = _Later("multivariate_normal")


def _nothing(*_: object, **__: object) -> float:
    return 0.0


def kalman_filter() -> Any:  # noqa: ANN401 - filterpy tells no types
    """Return filterpy's KalmanFilter.

    ``scipy.stats`` takes 0.8 s and 50 MB to load. While filterpy is imported an empty module stands in for it; who imports
    it later gets the real one, and so does filterpy when it uses a distribution.
    """
    if "filterpy.kalman" not in sys.modules and _PACKAGE not in sys.modules:
        sys.modules[_PACKAGE] = _StandIn(_PACKAGE)
        try:
            importlib.import_module("filterpy.kalman")
        finally:
            del sys.modules[_PACKAGE]
    from filterpy.kalman import KalmanFilter

    return KalmanFilter
