"""Kernels that no longer fit their sources leave numba's cache: also those whose own file is as it was."""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.common.kernel_cache import drop_stale
from services.common.process import prepare_process

ROOT = Path(__file__).parents[2]
INNER = (
    "from numba import njit\nfrom services.numbers import LIMIT\n\n@njit(cache=True)\ndef f():\n    return {} + LIMIT\n"
)
OUTER = "from numba import njit\nfrom services.inner import f\n\n@njit(cache=True)\ndef g():\n    return f() * 10\n"
ALONE = "from numba import njit\n\n@njit(cache=True)\ndef h():\n    return 3\n"
SOURCES = {
    "__init__": "",
    "inner": INNER.format(1),
    "outer": OUTER,
    "alone": ALONE,
    "numbers": "LIMIT = 0\n",
    "other": "import services.outer\n",
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "checkout"
    (folder / "services").mkdir(parents=True)
    for name, text in SOURCES.items():
        (folder / f"services/{name}.py").write_text(text)
    return folder


def cached(cache: Path, root: Path) -> Path:
    """Lay down what numba would keep of the three kernels."""
    folder = cache / f"services_{hashlib.sha1(str(root / 'services').encode()).hexdigest()}"
    folder.mkdir(parents=True)
    for name in ("inner.f-5", "outer.g-5", "alone.h-4"):
        for end in ("py311.nbi", "py311.1.nbc"):
            (folder / f"{name}.{end}").write_text("compiled")
    return folder


def kept(folder: Path) -> set[str]:
    return {path.name.split(".")[0] for path in folder.iterdir()}


def test_a_change_drops_the_kernels_that_stand_on_it_and_no_others(tmp_path: Path, root: Path) -> None:
    folder = cached(tmp_path / "cache", root)
    assert drop_stale(tmp_path / "cache", root) == []
    (root / "services/numbers.py").write_text("LIMIT = 10\n")
    assert drop_stale(tmp_path / "cache", root) == ["services/inner.py", "services/outer.py"]
    assert kept(folder) == {"alone"}
    assert drop_stale(tmp_path / "cache", root) == []


def test_what_is_touched_but_the_same_or_stands_on_nothing_compiled_drops_nothing(tmp_path: Path, root: Path) -> None:
    folder = cached(tmp_path / "cache", root)
    drop_stale(tmp_path / "cache", root)
    os.utime(root / "services/inner.py", ns=(1, 1))
    (root / "services/other.py").write_text("import services.inner\n")
    (root / "services/new.py").write_text(ALONE)
    assert drop_stale(tmp_path / "cache", root) == []
    assert kept(folder) == {"inner", "outer", "alone"}


def test_at_the_first_look_what_is_older_than_a_source_it_stands_on_is_dropped(tmp_path: Path, root: Path) -> None:
    cached(tmp_path / "cache", root)
    later_ns = (root / "services/inner.py").stat().st_mtime_ns + 10**12
    os.utime(root / "services/inner.py", ns=(later_ns, later_ns))
    assert drop_stale(tmp_path / "cache", root) == ["services/inner.py", "services/outer.py"]


def test_a_cache_that_cannot_be_written_is_left_alone(tmp_path: Path, root: Path) -> None:
    (tmp_path / "file").touch()
    assert drop_stale(tmp_path / "file/cache", root) == []


def test_every_process_looks_after_the_cache_before_it_loads_a_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    before = gc.get_threshold()
    prepare_process()
    gc.set_threshold(*before)
    (stamp,) = tmp_path.glob("*.sources")
    assert "services/slam/tracking.py" in stamp.read_text()


def test_numba_itself_would_go_on_with_the_old_code(tmp_path: Path, root: Path) -> None:
    cache = tmp_path / "cache"

    def answer(*, looked_after: bool) -> int:
        look = f"import sys; sys.path[:0] = [{str(ROOT)!r}]; from services.common.kernel_cache import drop_stale\n"
        look += f"from pathlib import Path; drop_stale(Path({str(cache)!r}), Path({str(root)!r}))\n"
        code = f"import sys; sys.path[:0] = [{str(root)!r}]; from services.outer import g; print(g())"
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": ""}
        for source in (look, code) if looked_after else (code,):
            done = subprocess.run(
                [sys.executable, "-c", source], env=environment, capture_output=True, text=True, check=True
            )
        return int(done.stdout)

    assert answer(looked_after=True) == 10
    (root / "services/inner.py").write_text(INNER.format(20))
    assert answer(looked_after=False) == 10, (
        "stale: numba asks for outer.py alone; where it does not, this module may go"
    )
    assert answer(looked_after=True) == 200
