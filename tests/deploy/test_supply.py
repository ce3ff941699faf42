"""Licences and the audit: nothing unknown passes, and no silence is called sound."""

from __future__ import annotations

import json
import subprocess
import sys
from email.message import Message
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "deploy"))

import audit  # noqa: E402 - lies beside the other scripts of deploy
import licences  # noqa: E402


def test_every_pin_has_a_licence_that_may_be_shipped() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "deploy/licences.py")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 80


def test_a_pin_that_is_not_installed_is_no_sound_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pins = tmp_path / "constraints.txt"
    monkeypatch.setattr(licences, "CONSTRAINTS", pins)
    pins.write_text("pytest==1\nopen3d==1\n")
    assert licences.main() == 0
    pins.write_text("pytest==1\nopen3d==1\nno-such-package==1\n")
    assert licences.main() == 1
    out, err = capsys.readouterr()
    assert "not looked at, for they are not installed here: no-such-package" in out
    assert err == "licences: no-such-package: not installed, so not looked at: make setup\n"


@pytest.mark.parametrize(
    ("name", "licence", "bad"),
    [("x", "", True), ("x", "GPL-3.0-only", True), ("x", "AGPLv3", True), ("x", "LGPL-3.0-or-later", False),
     ("x", "MIT", False), ("evo", "GPLv3", False), ("x", "GNU Lesser General Public License v3 (LGPLv3)", False)],
)  # fmt: skip
def test_what_may_not_be_shipped_is_told(name: str, licence: str, bad: bool) -> None:
    assert bool(licences.fault_of(name, licence)) is bad


def test_the_licence_comes_from_whatever_the_metadata_has() -> None:
    told = Message()
    told["Classifier"] = "License :: OSI Approved"
    told["Classifier"] = "License :: OSI Approved :: MIT License"
    assert licences.licence_of(told) == "MIT License"
    told["License-Expression"] = "BSD-3-Clause"
    assert licences.licence_of(told) == "BSD-3-Clause"


def entry(name: str, **more: object) -> dict[str, object]:
    return {"name": name, "version": "1", "vulns": [], **more}


@pytest.mark.parametrize(
    ("code", "out", "exit_code", "words"),
    [
        (1, "", 0, "not audited"),
        (0, "{}", 0, "not audited"),
        (0, json.dumps({"dependencies": [entry("a")]}), 0, "not audited in full: 1 of 2"),
        (0, json.dumps({"dependencies": [entry("a"), entry("b", skip_reason="unknown")]}), 0, "not audited in full"),
        (0, json.dumps({"dependencies": [entry("a"), entry("b")]}), 0, "audited: nothing"),
        (1, json.dumps({"dependencies": [entry("a"), entry("b", vulns=[{"id": "CVE-1"}])]}), 1, "b 1: CVE-1"),
    ],
)
def test_silence_is_never_called_sound(code: int, out: str, exit_code: int, words: str) -> None:
    found = audit.verdict(code, out, 2)
    assert found[0] == exit_code
    assert found[1].startswith(words) or words in found[1]
    assert found[1].startswith("audited") == (words == "audited: nothing")
