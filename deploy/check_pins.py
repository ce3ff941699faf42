"""Check that every pin of constraints.txt has a wheel for x86-64 and for aarch64, and print the exceptions.

Companion computers are ARM: a pin without an aarch64 wheel means a compiler on the aircraft. Asks pip to resolve each
pin for the platform without installing anything. Exit code 1 when a pin that treedock needs has no wheel.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# glibc 2.36 is Debian 12's; pip wants every older tag by name.
GLIBC_MINORS = (5, 12, 17, 24, 26, 27, 28, 31, 34, 35, 36)
PLATFORMS = ("x86_64", "aarch64")
KNOWN_EXCEPTIONS = {
    ("open3d-cpu", "aarch64"): "open3d is the package on aarch64; pyproject.toml chooses by marker",
    ("pyrealsense2", "aarch64"): "an extra for one camera; on ARM librealsense is built with its Python bindings",
}


def read_pins(path: Path) -> list[str]:
    """Return the ``name==version`` lines."""
    lines = (line.split("#")[0].strip() for line in path.read_text().splitlines())
    return [line for line in lines if line]


def pip_resolves(pins: list[str], machine: str, python: str) -> tuple[bool, str]:
    """Ask pip whether all pins have wheels for a machine; return its error text otherwise."""
    platforms = [f"--platform=manylinux_2_{minor}_{machine}" for minor in GLIBC_MINORS]
    platforms += [f"--platform=manylinux2014_{machine}", f"--platform=linux_{machine}"]
    with tempfile.TemporaryDirectory() as target:
        command = [
            sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--no-deps",
            "--disable-pip-version-check", "--only-binary=:all:", f"--python-version={python}", *platforms,
            f"--target={target}", *pins,
        ]  # fmt: skip
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    return result.returncode == 0, result.stderr


def missing_wheels(pins: list[str], machine: str, python: str) -> list[str]:
    """Return the pins that have no wheel for a machine."""
    missing: list[str] = []
    left = list(pins)
    while left:
        resolved, error = pip_resolves(left, machine, python)
        if resolved:
            return missing
        named = re.search(r"No matching distribution found for ([A-Za-z0-9_.-]+)==", error)
        if named is None:
            raise SystemExit(f"pip failed for another reason:\n{error}")
        bad = [pin for pin in left if pin.split("==")[0].lower() == named[1].lower()]
        if not bad:
            raise SystemExit(f"pip named {named[1]}, which is no pin:\n{error}")
        missing += bad
        left = [pin for pin in left if pin not in bad]
    return missing


def main() -> int:
    """Run the check and print its result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default="3.11", help="Python version of the target (default 3.11)")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    pins = read_pins(ROOT / "constraints.txt")
    unexplained = 0
    report: dict[str, dict[str, str]] = {}
    for machine in PLATFORMS:
        found = missing_wheels(pins, machine, arguments.python)
        report[machine] = {pin: KNOWN_EXCEPTIONS.get((pin.split("==")[0], machine), "") for pin in found}
        unexplained += sum(1 for reason in report[machine].values() if not reason)
    if arguments.json:
        print(json.dumps(report))
        return int(unexplained > 0)
    for machine, exceptions in report.items():
        print(f"{machine}: {len(pins) - len(exceptions)} of {len(pins)} pins have a wheel")
        for pin, reason in exceptions.items():
            print(f"  {pin}: none ({reason or 'NOT EXPLAINED: find a version that has one'})")
    return int(unexplained > 0)


if __name__ == "__main__":
    sys.exit(main())
