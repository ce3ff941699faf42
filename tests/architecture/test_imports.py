"""The shape of the system, checked statically and in fresh interpreters."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = ("open3d", "cv2", "gtsam", "numba", "scipy", "filterpy", "zenoh")
# what a service may know besides its core: the files that are allowed to touch bus, clock and files
SHELL_FILES = {"service.py", "__main__.py", "config.py", "bus.py"}
MAY_READ_TRUTH = {"simulator", "evaluate", "cli"}
CORE_PACKAGES = ("slam", "mapper", "detector", "navigator", "fleet")
ADDRESS_OR_MACHINE_PATH = re.compile(
    r"pypi\s*[.]\s*\w+|pythonhosted|(?:extra-)?index-url\b|(?<![\w.])/(?:work|root)/\w|(?<![\w.])/tmp/(?:lead|missions|bash)"
)
"""Of package indexes, and of the machine it was written on."""
PACKAGE_OF = {
    "cv2": "opencv-python-headless", "google": "protobuf", "mcap_protobuf": "mcap-protobuf-support", "open3d": "open3d-cpu",
    "psycopg": "psycopg", "rerun": "rerun-sdk", "serial": "pyserial", "zenoh": "eclipse-zenoh",
    "matplotlib": "evo",  # a bench's figures alone; comes with it
}  # fmt: skip
"""Modules that are not called as the package that brings them."""
FORBIDDEN_IN_CORE = ("zenoh", "services.common.context", "services.common.bus", "services.common.runtime", "open3d")


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def loaded_by(code: str) -> set[str]:
    report = f"{code}\nimport sys\nprint(' '.join(m for m in {HEAVY!r} if m in sys.modules))"
    result = subprocess.run([sys.executable, "-c", report], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(result.stdout.split())


def test_every_package_that_is_used_is_a_declared_one() -> None:
    """Also those that are imported late: what only a real aircraft needs no other test would miss."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    declared = {re.split(r"[^a-z0-9-]", name.lower())[0] for name in wanted}
    used = {
        name.split(".")[0]: path
        for folder in ("schemas", "services")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for name in imported(path)
    }
    ours = {"schemas", "services", "tests", *sys.stdlib_module_names}
    missing = {
        name: str(path.relative_to(ROOT))
        for name, path in used.items()
        if name not in ours and PACKAGE_OF.get(name, name.replace("_", "-")) not in declared
    }
    assert not missing


def test_schemas_load_nothing_heavy() -> None:
    assert loaded_by("import schemas.topics, schemas.codec") == set()


def test_the_command_line_loads_nothing_heavy_for_help() -> None:
    code = (
        "import sys; sys.argv = ['treedock', '--help']\n"
        "import contextlib, io\n"
        "from services.cli.app import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    main()\n"
        "assert 'pydantic' not in sys.modules, 'a third of the time that --help may take'"
    )
    assert loaded_by(code) == set()


def test_no_flying_process_reads_the_truth() -> None:
    for path in (ROOT / "services").rglob("*.py"):
        package = path.relative_to(ROOT / "services").parts[0]
        if package in MAY_READ_TRUTH:
            continue
        # its settings are part of the one tree; they hold no truth
        names = {n for n in imported(path) if not n.startswith("services.simulator.config")}
        reads = {
            n for n in names if n.startswith("services.simulator") or n.rsplit(".", 1)[-1] in {"SIM_TRUTH", "SimTruth"}
        }
        assert not reads, f"{path.relative_to(ROOT)} reaches for the simulator's truth: {sorted(reads)}"
        assert "sim/truth" not in path.read_text(), f"{path.relative_to(ROOT)} names sim/truth"


@pytest.mark.parametrize("package", CORE_PACKAGES)
def test_core_files_know_no_bus(package: str) -> None:
    for path in (ROOT / "services" / package).rglob("*.py"):
        if path.name in SHELL_FILES:
            continue
        bad = {n for n in imported(path) if n.startswith(FORBIDDEN_IN_CORE)}
        assert not bad, f"{path.relative_to(ROOT)} is core but imports {sorted(bad)}"


def test_no_address_or_machine_path_in_the_tree() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    for name in listed:
        path = ROOT / name
        if path.suffix in {".py", ".toml", ".txt", ".md", ".sh", ""} and path.is_file() and path != Path(__file__):
            text = path.read_text(errors="ignore")
            found = ADDRESS_OR_MACHINE_PATH.search(text)
            assert found is None, f"{name} holds {found.group()!r}"
