"""Compiled kernels that no longer fit their sources leave numba's cache. Imports nothing heavy.

numba compiles the kernels (and constants) that a kernel uses into it, but asks at the next start only whether the kernel's own
file changed: after an update in place, or an edit, it would go on with the old code of what it calls. Here each file with
kernels is known with all of our modules that it imports, directly or not; when one of them changed, its kernels go.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

_NAMES = "services"
_MARK = b"@njit"
_PYTHON = ".py"


def drop_stale(cache: Path, root: Path) -> list[str]:
    """Remove from the cache the kernels of the checkout or installation at ``root`` that may be stale.

    One process at a time does it, and only after a source changed (size or time of change, as numba itself looks): else it
    costs some milliseconds. A cache that cannot be written is left alone: who installed it sees to it (deploy/install).

    Returns:
        The files whose kernels were removed, relative to ``root``; nothing when all fit.
    """
    look = _look(root)
    stamp = cache / f"{root.name}_{_folder_hash(str(root))}.sources"
    if _read(stamp)[:1] == [look]:
        return []
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            known = _read(stamp)
            if known[:1] == [look]:
                return []  # another process was first
            return _drop(cache, root, look, dict(line.split(" ", 1) for line in known[1:]), stamp)
    except OSError:
        return []


def _drop(cache: Path, root: Path, look: str, known: Mapping[str, str], stamp: Path) -> list[str]:
    closures = dict(_closures(root))
    now = {name: _content_hash(root, files) for name, files in closures.items()}
    stale = []
    for name, files in closures.items():
        entries = _entries(cache, root / name)
        if name in known:
            fits = known[name] == now[name]
        else:  # never looked at: what was compiled before the last change of a source may be stale
            newest = max((root / file).stat().st_mtime_ns for file in files)
            fits = all(entry.stat().st_mtime_ns >= newest for entry in entries)
        if not fits:
            for entry in entries:
                entry.unlink(missing_ok=True)
            stale += [name] if entries else []
    new = stamp.with_suffix(f".{os.getpid()}")
    new.write_text("\n".join([look, *(f"{name} {content}" for name, content in sorted(now.items()))]), encoding="utf-8")
    new.replace(stamp)
    return sorted(stale)


def _look(root: Path) -> str:
    """Return what stands for sizes and times of change of all our sources."""
    digest = hashlib.sha1(usedforsecurity=False)
    for folder, folders, files in os.walk(root / _NAMES):
        folders.sort()
        for name in sorted(files):
            if name.endswith(_PYTHON):
                found = os.stat(f"{folder}/{name}")  # noqa: PTH116 - a Path for each costs as much as the question
                digest.update(f"{folder}/{name} {found.st_size} {found.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _closures(root: Path) -> Iterator[tuple[str, frozenset[str]]]:
    """Yield each file with kernels, and it with all of our files that it imports, directly or not; relative to ``root``."""
    imports: dict[str, frozenset[str]] = {}
    for path in sorted((root / _NAMES).rglob(f"*{_PYTHON}")):
        name = path.relative_to(root).as_posix()
        if _MARK not in path.read_bytes():
            continue
        found, todo = set[str](), [name]
        while todo:
            at = todo.pop()
            if at not in found:
                found.add(at)
                if at not in imports:
                    imports[at] = _imported(root, at)
                todo += imports[at]
        yield name, frozenset(found)


def _imported(root: Path, name: str) -> frozenset[str]:
    import ast

    modules = set[str]()
    for node in ast.walk(ast.parse((root / name).read_bytes())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    files = (f"{module.replace('.', '/')}{_PYTHON}" for module in modules if module.startswith(f"{_NAMES}."))
    return frozenset(file for file in files if (root / file).is_file())


def _entries(cache: Path, source: Path) -> list[Path]:
    """Return the files that numba keeps for a source (numba.core.caching: folder by its hash, names begin with the module's)."""
    folder = cache / f"{source.parent.name}_{_folder_hash(str(source.parent))}"
    return [path for path in folder.glob(f"{source.stem}.*") if path.suffix in {".nbi", ".nbc"}]


def _folder_hash(path: str) -> str:
    return hashlib.sha1(path.encode(), usedforsecurity=False).hexdigest()


def _content_hash(root: Path, files: frozenset[str]) -> str:
    digest = hashlib.sha1(usedforsecurity=False)
    for name in sorted(files):
        content = (root / name).read_bytes()
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _read(stamp: Path) -> list[str]:
    try:
        return stamp.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
