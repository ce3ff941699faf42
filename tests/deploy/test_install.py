"""The installer stages what the units need, touches nothing in a dry run, and takes everything away again."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from schemas.topics import TOPICS
from services.cli.service_command import OPTIONAL, SERVICES
from services.common.config_loader import load
from services.common.errors import InputError
from services.fleet.journal import book_path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "deploy"))

import actions  # noqa: E402 - lies beside the script that runs before anything is installed
import checks  # noqa: E402
import installer  # noqa: E402
import units  # noqa: E402

HAS_SYSTEMD = shutil.which("systemd-analyze") is not None


def options(tmp_path: Path, *arguments: str) -> installer.Options:
    return installer.parse(["--root", str(tmp_path), *arguments])[1]


def staged(tmp_path: Path, *arguments: str) -> None:
    """Everything but the environment, which takes minutes and a package index: an empty file stands for it."""
    given = options(tmp_path, *arguments)
    for action in installer.installation(given):
        if not isinstance(action, actions.Run):
            action.do()
        elif action.needed and "venv" in action.command:
            python = given.at(given.prefix) / "bin/python"
            python.parent.mkdir(parents=True, exist_ok=True)
            python.touch()


def test_the_unit_files_are_the_tables() -> None:
    written = {path.name: path.read_text() for path in (ROOT / "deploy/systemd").iterdir()}
    assert written == units.files(), "run: python deploy/units.py"


def test_there_is_a_unit_for_every_service_and_only_for_those() -> None:
    assert {unit.name for unit in units.UNITS} == {*SERVICES, *OPTIONAL, "station"} - {"simulator"}


def test_what_is_optional_is_not_started_with_the_others() -> None:
    wanted = units.target_text(ground=False)
    assert {unit.name for unit in units.UNITS if unit.optional} == set(OPTIONAL)
    assert all(f"treedock-{name}.service" not in wanted for name in OPTIONAL)
    assert "treedock-slam.service" in wanted


def test_autopilot_and_slam_come_first_when_the_processor_is_short() -> None:
    first, second, *rest = sorted(units.UNITS, key=lambda unit: -unit.cpu_weight)
    assert {first.name, second.name} == {"autopilot", "slam"}
    assert all(unit.cpu_weight <= second.cpu_weight for unit in rest)
    assert {t.producer for t in TOPICS} >= {"slam"}


@pytest.mark.parametrize("unit", units.UNITS, ids=lambda unit: unit.name)
def test_every_unit_is_supervised_as_decided(unit: units.Unit) -> None:
    text = units.service_text(unit)
    for line in ("Type=notify", "WatchdogSec=5", "Restart=always", "RestartSec=500ms", "StartLimitIntervalSec=0",
                 "TimeoutStopSec=3", "User=treedock", "LimitMEMLOCK=infinity", "ProtectSystem=strict"):  # fmt: skip
        assert f"\n{line}\n" in text
    assert ("DeviceAllow=" in text) == (unit.name in {"camera", "second_camera", "autopilot"}), (
        "devices only where needed"
    )
    assert ("MemoryDenyWriteExecute" in text) != unit.compiles


def imported_by(module: str, seen: set[str]) -> None:
    """Add to ``seen`` what a module of ours imports, at once or later, directly or through others of ours."""
    place = ROOT.joinpath(*module.split("."))
    file = next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.exists()), None)
    if module in seen or file is None:
        seen.add(module)
        return
    seen.add(module)
    for node in ast.walk(ast.parse(file.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.startswith(("services.", "schemas.")):
                imported_by(name, seen)
            else:
                seen.add(name.partition(".")[0])


@pytest.mark.parametrize("unit", units.UNITS, ids=lambda unit: unit.name)
def test_a_service_with_kernels_may_run_the_code_it_makes_and_no_other_may(unit: units.Unit) -> None:
    """MemoryDenyWriteExecute would end such a service at its first kernel, or leave another less guarded than it could be."""
    modules = {
        "refiner": "services.detector.refine.service",
        "autopilot": "services.navigator.autopilot.service",
        "second_camera": "services.fusion.second_camera",
        "second_slam": "services.fusion.second_slam",
    }
    seen: set[str] = set()
    imported_by(modules.get(unit.name, f"services.{unit.name}.service"), seen)
    assert "schemas.topics" in seen
    assert unit.compiles == ("numba" in seen)


@pytest.mark.skipif(not HAS_SYSTEMD, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("unit", units.UNITS, ids=lambda unit: unit.name)
def test_exposure_is_at_most_two(unit: units.Unit, tmp_path: Path) -> None:
    path = tmp_path / f"treedock-{unit.name}.service"
    path.write_text(units.service_text(unit))
    command = ["systemd-analyze", "security", "--offline=yes", "--threshold=20", "--no-pager", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-400:]


@pytest.mark.skipif(not HAS_SYSTEMD, reason="systemd-analyze is not installed")
def test_systemd_verifies_the_units(tmp_path: Path) -> None:
    binary = tmp_path / "opt/bin/treedock"
    binary.parent.mkdir(parents=True)
    binary.write_text("#!/bin/sh\n")
    binary.chmod(0o755)
    for name, text in units.files(str(tmp_path / "opt")).items():
        (tmp_path / name).write_text(text)
    paths = [str(path) for path in sorted(tmp_path.glob("treedock*"))]
    done = subprocess.run(["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False)
    ours = [line for line in done.stderr.splitlines() if "treedock" in line and "Documentation" not in line]
    assert ours == []
    assert done.returncode == 0


def test_a_staged_installation_is_complete_and_its_configuration_is_read(tmp_path: Path) -> None:
    staged(tmp_path, "--uav", "kea-2")
    assert set(units.files()) == {path.name for path in (tmp_path / "etc/systemd/system").iterdir()}
    assert (tmp_path / "etc/udev/rules.d/60-treedock.rules").is_file()
    assert oct((tmp_path / "etc/treedock/certs").stat().st_mode)[-3:] == "700"
    found = load(environ={}, system_directory=tmp_path / "etc/treedock").config
    assert found.uav == "kea-2"
    assert found.router.listen_host == "127.0.0.1"


def test_a_station_is_told_what_is_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    staged(tmp_path, "--role", "station", "--uav", "kea-2")
    assert load(environ={}, system_directory=tmp_path / "etc/treedock").config.uav == "kea-2"
    text = (tmp_path / installer.CONFIG).read_text()
    assert "identity" in text
    assert "autopilot" not in text
    assert installer.main(["--root", str(tmp_path), "--role", "station", "--dry-run"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert f"keep    {tmp_path / installer.CONFIG}" in said
    assert all(
        line.split()[0] in {"run", "have", "write", "same", "keep", "make", "link", "remove", "gone"} for line in said
    )


@pytest.mark.parametrize("role", ["aircraft", "station"])
def test_the_commented_settings_are_real_ones(tmp_path: Path, role: str) -> None:
    text = (ROOT / "deploy/etc" / installer.CONFIG_OF[role]).read_text().replace("@UAV@", "uav1")
    lines = [
        line.removeprefix("# ") if line.startswith(("# [", "# ")) and ("=" in line or "# [" in line) else line
        for line in text.splitlines()
    ]
    body = "\n".join(line for line in lines if not line.startswith("#"))
    path = tmp_path / "all.toml"
    path.write_text(body + "\n[router2]\nx = 1\n")
    assert tomllib.loads(body)["security"]["folder"] == "/etc/treedock/certs"
    with pytest.raises(InputError, match="router2"):
        load(path, environ={}, system_directory=tmp_path / "none")
    path.write_text(body)
    config = load(path, environ={}, system_directory=tmp_path / "none").config
    assert config.router.protocol == "tls"
    if role == "aircraft":
        assert config.autopilot.vehicle == "real"


def uncommented(text: str, *tables: str) -> str:
    """Return a file of deploy/etc with the commented settings of these tables in force."""
    lines, table = list[str](), ""
    for line in text.splitlines():
        setting = re.fullmatch(r"# (\[\w+\]|\w+ = .*)", line)
        if head := re.fullmatch(r"(?:# )?\[(\w+)\]", line):
            table = head[1]
        lines.append(setting[1] if setting and table in tables else line)
    return "\n".join(lines)


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "deploy/etc").iterdir()))
def test_every_commented_block_can_be_uncommented_as_it_is_meant(tmp_path: Path, name: str) -> None:
    text = (ROOT / "deploy/etc" / name).read_text().replace("@UAV@", "uav1")
    tables = re.findall(r"^(?:# )?\[(\w+)\]", text, re.MULTILINE)
    assert "security" in tables
    together = {"security": ("security", "router"), "router": ("security", "router")}
    path = tmp_path / name
    for chosen in [tables, *(together.get(table, (table,)) for table in tables)]:
        path.write_text(uncommented(text, *chosen))
        tree = load(path, environ={}, system_directory=tmp_path / "none").config
        for table, values in tomllib.loads(path.read_text()).items():
            if isinstance(values, dict):
                told = getattr(tree, table).model_dump(mode="json")
                assert told == merged(told, values), f"{chosen}: [{table}]"


def merged(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return ``under`` with the values of ``over``, section by section."""
    return under | {k: merged(under[k], v) if isinstance(v, dict) else v for k, v in over.items()}


def test_an_installed_stations_files_do_not_depend_on_who_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    staged(tmp_path, "--role", "station")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    places = set()
    for home in ("/root", "/var/lib/treedock"):
        monkeypatch.setenv("HOME", home)
        station = load(environ={}, system_directory=tmp_path / "etc/treedock").config.station
        places.add((station.inventory.database, str(book_path(station.fleet))))
    state = next(unit.state for unit in units.UNITS if unit.ground).split()[-1]
    folder = f"/var/lib/{state}"
    assert places == {(f"{folder}/inventory.gpkg", f"{folder}/fleet.json")}


def test_data_of_an_older_station_are_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, config = tmp_path / installer.HOME_DATA, tmp_path / installer.CONFIG
    old.mkdir(parents=True)
    (old / "inventory.gpkg").touch()
    staged(tmp_path, "--role", "station")

    def note() -> str:
        assert installer.main(["--root", str(tmp_path), "--role", "station", "--dry-run"]) == 0
        return capsys.readouterr().out.partition("note: ")[2]

    assert f"mv {old / 'inventory.gpkg'}* /var/lib/treedock/inventory/" in note()
    config.write_text('uav = "uav1"\n')
    told = note()
    assert f"add to {config}" in told
    config.write_text("\n".join(line.strip() for line in told.splitlines()[1:]))
    assert load(environ={}, system_directory=config.parent).config.station.inventory.database == str(
        old / "inventory.gpkg"
    )
    assert note() == ""


def test_again_changes_nothing_and_keeps_the_administrators_file(tmp_path: Path) -> None:
    staged(tmp_path)
    own = tmp_path / "etc/treedock/10-treedock.toml"
    own.write_text('uav = "mine"\n')
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    staged(tmp_path, "--uav", "other")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before
    assert own.read_text() == 'uav = "mine"\n'


def runs(tmp_path: Path) -> list[str]:
    """The commands that would be run now."""
    actions_now = installer.installation(options(tmp_path, "--no-realsense"))
    return [" ".join(a.command) for a in actions_now if isinstance(a, actions.Run) and a.needed]


def test_packages_are_installed_again_only_when_something_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the kernels are compiled anew then: numba looks at a kernel's own file, not at those of the kernels inside it."""
    assert any("pip install" in command for command in runs(tmp_path))
    staged(tmp_path)
    kernels = tmp_path / "var/cache/treedock/numba/services.abc/kernel.nbc"
    kernels.parent.mkdir(parents=True)
    kernels.write_bytes(b"compiled")
    staged(tmp_path)
    assert kernels.exists()
    assert not any("pip install" in command for command in runs(tmp_path))
    python = tmp_path / "opt/treedock/bin/python"
    python.unlink()
    python.symlink_to("python3.old")  # the system's Python was upgraded
    assert [command.split()[2] for command in runs(tmp_path)[:2]] == ["venv", "pip"]
    staged(tmp_path)
    kernels.parent.mkdir(parents=True)
    kernels.write_bytes(b"compiled")
    monkeypatch.setattr(installer, "source_hash", lambda: "another")
    assert any("pip install" in command for command in runs(tmp_path))
    staged(tmp_path)
    assert not kernels.exists()


def test_only_an_aircraft_compiles_kernels_and_only_those_that_it_runs(tmp_path: Path) -> None:
    warming = {}
    for role in ("aircraft", "station"):
        actions_now = installer._activation(options(tmp_path, "--role", role))
        warming[role] = [
            a.command for a in actions_now if isinstance(a, actions.Run) and "warm" in a.command and a.needed
        ]
    assert [command[-2:] for command in warming["aircraft"]] == [("warm", "--aboard")]
    assert warming["station"] == []
    assert not any(unit.compiles for unit in units.UNITS if unit.ground or unit.name == "router")


def test_the_source_is_known_by_every_byte_and_name(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "constraints.txt", "schemas/a.py", "services/x/b.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    seen = {installer.source_hash(tmp_path)}
    (tmp_path / "services/x/b.py").write_text("services/x/c.py")
    seen.add(installer.source_hash(tmp_path))
    (tmp_path / "services/x/b.py").rename(tmp_path / "services/x/d.py")
    seen.add(installer.source_hash(tmp_path))
    (tmp_path / "constraints.txt").write_text("numpy==2")
    seen.add(installer.source_hash(tmp_path))
    assert len(seen) == 4
    (tmp_path / "services/x/__pycache__").mkdir()
    (tmp_path / "services/x/__pycache__/d.pyc").write_text("made by Python")
    assert installer.source_hash(tmp_path) in seen


def test_another_prefix_reaches_the_units(tmp_path: Path) -> None:
    staged(tmp_path, "--prefix", "/usr/local/treedock")
    text = (tmp_path / "etc/systemd/system/treedock-slam.service").read_text()
    assert "ExecStart=/usr/local/treedock/bin/treedock slam" in text


def test_the_command_is_found_by_name_and_nobody_elses_is_touched(tmp_path: Path) -> None:
    staged(tmp_path, "--prefix", "/srv/td")
    command = tmp_path / "usr/local/bin/treedock"
    assert str(command.readlink()) == "/srv/td/bin/treedock"
    assert installer.main(["uninstall", "--root", str(tmp_path)]) == 0
    assert command.is_symlink(), "of another installation"
    assert installer.main(["uninstall", "--root", str(tmp_path), "--prefix", "/srv/td"]) == 0
    assert not command.is_symlink()
    command.write_text("theirs")
    staged(tmp_path)
    assert command.read_text() == "theirs"


@pytest.mark.parametrize(
    ("python", "home"),
    [
        ("/root/.pyenv/versions/3.11/bin/python3", "/root"),
        ("/home/eve/venv/bin/python", "/home"),
        ("/usr/bin/python3", ""),
    ],
)
def test_a_python_that_the_services_may_not_read_is_known(python: str, home: str) -> None:
    assert checks.home_of(Path(python)) == home


@pytest.mark.parametrize(("bounding", "needed"), [("0000000000004000", True), ("0000000000000000", False)])
def test_where_the_limit_cannot_be_raised_the_capability_is_taken_if_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, bounding: str, needed: bool
) -> None:
    def refused(*_: object) -> None:
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr("resource.setrlimit", refused)
    (tmp_path / "status").write_text(f"CapBnd:\t{bounding}\n")
    assert installer.needs_capability(tmp_path / "status") == needed
    monkeypatch.setattr("resource.setrlimit", lambda *_: None)
    assert not installer.needs_capability(tmp_path / "status")


@pytest.mark.skipif(not HAS_SYSTEMD, reason="systemd-analyze is not installed")
def test_exposure_stays_low_with_the_capability(tmp_path: Path) -> None:
    for unit in units.UNITS:
        text = units.service_text(unit) + units.MEMORY_LOCK
        path = tmp_path / f"treedock-{unit.name}.service"
        path.write_text(text)
        command = ["systemd-analyze", "security", "--offline=yes", "--threshold=20", "--no-pager", str(path)]
        assert subprocess.run(command, capture_output=True, check=False).returncode == 0, unit.name


def test_what_is_laid_down_can_be_read_whatever_roots_umask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions.Run, "do", lambda _: None)
    before = os.umask(0o077)
    try:
        assert installer.main(["--root", str(tmp_path)]) == 0
    finally:
        os.umask(before)
    closed = {path for path in tmp_path.rglob("*") if not path.is_symlink() and path.stat().st_mode & 0o044 != 0o044}
    assert closed == {tmp_path / "etc/treedock/certs"}


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert installer.main(["--root", str(tmp_path / "new"), "--dry-run"]) == 0
    assert not (tmp_path / "new").exists()
    out = capsys.readouterr().out
    assert "treedock-slam.service" in out
    assert "pip install" in out


def test_uninstall_leaves_configuration_and_data_unless_purged(tmp_path: Path) -> None:
    staged(tmp_path)
    assert installer.main(["uninstall", "--root", str(tmp_path)]) == 0
    assert not (tmp_path / "opt/treedock").exists()
    assert list((tmp_path / "etc/systemd/system").iterdir()) == []
    assert (tmp_path / "etc/treedock/10-treedock.toml").exists()
    assert installer.main(["uninstall", "--purge", "--root", str(tmp_path)]) == 0
    assert not (tmp_path / "etc/treedock").exists()


@pytest.mark.parametrize("own", [False, True])
def test_uninstall_leaves_no_empty_folder_and_no_drop_in_of_others(tmp_path: Path, *, own: bool) -> None:
    staged(tmp_path)
    ours = tmp_path / installer.MEMORY_LOCK
    ours.parent.mkdir(parents=True, exist_ok=True)
    ours.touch()
    if own:
        (ours.parent / "50-mine.conf").touch()
    assert installer.main(["uninstall", "--root", str(tmp_path)]) == 0
    assert not ours.exists()
    assert ours.parent.exists() == own


@pytest.mark.parametrize("prefix", ["/", "/usr", "/usr/../usr", "/usr/"])
@pytest.mark.parametrize("verb", ["install", "uninstall"])
def test_a_folder_that_the_installer_did_not_make_is_never_taken(
    tmp_path: Path, verb: str, prefix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = tmp_path / "usr/bin/python"
    theirs.parent.mkdir(parents=True)
    theirs.touch()
    assert installer.main([verb, "--root", str(tmp_path), "--prefix", prefix]) == 2
    assert theirs.exists()
    assert capsys.readouterr().err.startswith("deploy/install: --prefix /")


def test_what_an_attempt_left_that_broke_off_is_known_as_ours(tmp_path: Path) -> None:
    first, *_ = installer.installation(options(tmp_path))
    first.do()
    (tmp_path / "opt/treedock/bin").mkdir()
    assert installer.main(["--dry-run", "--root", str(tmp_path)]) == 0
    assert installer.main(["uninstall", "--root", str(tmp_path)]) == 0
    assert not (tmp_path / "opt/treedock").exists()


@pytest.mark.parametrize("prefix", ["/home/eve/treedock", "/run/user/1000/treedock", "/tmp/treedock"])
def test_where_the_services_see_nothing_is_no_place(prefix: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert installer.main(["--dry-run", "--prefix", prefix]) == 2
    assert "the services see nothing of" in capsys.readouterr().err


def test_a_name_that_changes_nothing_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    staged(tmp_path, "--uav", "kea")
    for arguments, told in ([], False), (["--uav", "kea"], False), (["--uav", "tui"], True):
        assert installer.main(["--dry-run", "--root", str(tmp_path), *arguments]) == 0
        assert ("says uav = 'kea', not 'tui'" in capsys.readouterr().out) == told


@pytest.mark.parametrize(
    "arguments",
    [["--uav", "a b"], ["--uav", ""], ["--uav", "x/../y"], ["--uav", "x" * 65], ["--uav", "station"],
     ["--prefix", "opt"], ["--prefix", "/opt/tree dock"], ["--prefix", "/opt/50%n"],
     ["--wheels", "/nowhere"], ["--purge"]],
)  # fmt: skip
def test_what_cannot_work_is_refused_first(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert installer.main(["--root", str(tmp_path / "r"), *arguments]) == 2
    assert not (tmp_path / "r").exists()
    assert capsys.readouterr().err.startswith("deploy/install: --")
