"""The licence of every pinned package, from its own metadata: ``python deploy/licences.py``. Run by deploy/check.

Fails when a package tells none, or when one that is shipped (not a test's) is under a licence whose terms would reach
treedock itself.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
_STRONG = re.compile(r"(?<![L])\b(A?GPL)", re.IGNORECASE)
_WEAK = re.compile(r"LGPL|Lesser", re.IGNORECASE)
TEST_ONLY = frozenset({"evo"})
"""Used by tests and benches alone, never shipped nor imported by a service."""
TOLD_ELSEWHERE = {"open3d-cpu": "MIT"}
"""Packages whose metadata is silent, with what their own LICENSE file says."""
ELSEWHERE = frozenset({"open3d", "pyrealsense2"})
"""Pins of another platform or of an extra: told when they are not installed here."""


def licence_of(package: Any) -> str:  # noqa: ANN401 - the protocol lacks get, which every version has
    """Return the licence in the words of the package's metadata (an email message), empty when it tells none."""
    expression = package.get("License-Expression")
    if expression:
        return str(expression).strip()
    names = [c.split("::")[-1].strip() for c in package.get_all("Classifier") or [] if c.startswith("License ::")]
    names = [name for name in names if name != "OSI Approved"]
    if names:
        return ", ".join(names)
    first = str(package.get("License") or "").strip().splitlines()
    return first[0][:60] if first else ""


def pinned() -> list[str]:
    """Return the names in constraints.txt."""
    lines = (line.split("#")[0].split(";")[0].strip() for line in CONSTRAINTS.read_text().splitlines())
    return [line.partition("==")[0].partition("[")[0] for line in lines if "==" in line]


def fault_of(name: str, licence: str) -> str:
    """Return what is wrong with a package's licence, empty when nothing is."""
    if not licence:
        return "tells no licence"
    if name not in TEST_ONLY and _STRONG.search(licence) and not _WEAK.search(licence):
        return f"{licence}: its terms would reach treedock"
    return ""


def main() -> int:
    """Print the list; 1 when something is wrong with it."""
    faults: list[str] = []
    absent: list[str] = []
    for name in sorted(pinned(), key=str.lower):
        try:
            licence = TOLD_ELSEWHERE.get(name) or licence_of(metadata(name))
        except PackageNotFoundError:
            absent.append(name)
            continue
        fault = fault_of(name, licence)
        sys.stdout.write(f"{name:32} {licence}{'   <-- ' + fault if fault else ''}\n")
        if fault:
            faults.append(f"{name}: {fault}")
    if absent:
        sys.stdout.write(f"not looked at, for they are not installed here: {', '.join(absent)}\n")
    faults += [f"{name}: not installed, so not looked at: make setup" for name in absent if name not in ELSEWHERE]
    for fault in faults:
        sys.stderr.write(f"licences: {fault}\n")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
