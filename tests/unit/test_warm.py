"""Every kernel that Python calls is compiled or loaded by its package's ``warm``: none compiles in flight."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from services.cli import warm

APART = {
    "services.slam.vocabulary.assign": "makes the vocabulary that is shipped",
}
"""Not used in flight."""


PACKAGES = ("slam", "mapper", "camera", "detector", "detector.refine")


@pytest.mark.parametrize("package", PACKAGES)
def test_warm_leaves_no_kernel_that_python_calls_uncompiled(package: str) -> None:
    importlib.import_module(f"services.{package}.warm").warm()
    cold = {name for name, kernel in _called_by_python(f"services.{package}") if not kernel.signatures}
    assert cold <= set(APART), f"{sorted(cold - set(APART))} would compile in flight"


def test_aboard_all_of_them_are_warmed() -> None:
    assert set(warm.PACKAGES) - warm.NOT_ABOARD == {f"services.{package}" for package in PACKAGES}


def _called_by_python(package: str) -> Iterator[tuple[str, Dispatcher]]:
    root = importlib.import_module(package)
    for found in pkgutil.walk_packages(root.__path__, package + "."):
        if found.name.endswith("__main__") or _another(found.name, package):
            continue
        module = importlib.import_module(found.name)
        for code, names in _functions(module):
            words = set(_words(code))
            within = [vars(value) for value in map(names.get, words) if isinstance(value, types.ModuleType)]
            for value in (space.get(word) for space in (names, *within) for word in words):
                if isinstance(value, Dispatcher):
                    yield f"{value.py_func.__module__}.{value.py_func.__name__}", value


def _another(module: str, package: str) -> bool:
    """Return whether a module belongs to a package inside this one that is warmed for itself."""
    inner = [f"services.{name}" for name in PACKAGES if f"services.{name}".startswith(package + ".")]
    return any(f"{module}.".startswith(f"{name}.") for name in inner)


def _functions(module: types.ModuleType) -> Iterator[tuple[types.CodeType, dict[str, object]]]:
    """Yield the code and the globals of a module's functions and methods; of kernels only those that are entered."""
    for value in list(vars(module).values()):
        owners = [value, *vars(value).values()] if isinstance(value, type) else [value]
        for owner in owners:
            function = owner.fget if isinstance(owner, property) else owner
            if isinstance(function, types.FunctionType) and function.__module__ == module.__name__:
                yield function.__code__, function.__globals__


def _words(code: types.CodeType) -> Iterator[str]:
    """Yield the names that a function and those within it use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _words(constant)


def test_python_is_compiled_where_it_may_not_write_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for package in ("schemas", "services"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "module.py").write_text("VALUE = 1\n")
    assert warm.compile_python(tmp_path)
    assert all(list((tmp_path / package / "__pycache__").glob("module.*.pyc")) for package in ("schemas", "services"))


def test_a_module_that_cannot_be_compiled_is_told_of_by_the_result_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "schemas").mkdir()
    (tmp_path / "services").mkdir()
    (tmp_path / "services" / "module.py").write_text("def\n")
    assert not warm.compile_python(tmp_path)
    assert capfd.readouterr() == ("", "")
