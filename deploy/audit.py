"""Known vulnerabilities of the pinned packages: ``python deploy/audit.py``. Run by deploy/check.

Says ``audited`` only when a database really answered about every pin; else ``not audited`` and why. Fails on a finding.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
_WITHIN_S = 60.0


def verdict(returncode: int, out: str, pins: int) -> tuple[int, str]:
    """Return exit code and words for what pip-audit printed about ``pins`` packages."""
    try:
        entries = json.loads(out)["dependencies"]
    except (ValueError, KeyError, TypeError):
        return 0, "not audited: the database of vulnerabilities did not answer"
    skipped = [entry["name"] for entry in entries if "skip_reason" in entry]
    found = [f"{e['name']} {e['version']}: {v['id']}" for e in entries for v in e.get("vulns", ())]
    if found:
        return 1, "vulnerable: " + "; ".join(found)
    if returncode or skipped or len(entries) < pins:
        return 0, f"not audited in full: {len(entries) - len(skipped)} of {pins} packages were looked up"
    return 0, f"audited: nothing is known against {len(entries)} packages"


def main() -> int:
    """Audit; print one line."""
    pins = sum("==" in line for line in CONSTRAINTS.read_text().splitlines() if not line.startswith("#"))
    tool = shutil.which("pip-audit")
    if tool is None:
        sys.stdout.write("not audited: pip-audit is not installed\n")
        return 0
    command = [tool, "--requirement", str(CONSTRAINTS), "--no-deps", "--disable-pip", "--format", "json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_WITHIN_S, check=False)
    except subprocess.TimeoutExpired:
        sys.stdout.write(f"not audited: no answer within {_WITHIN_S:.0f} s\n")
        return 0
    code, words = verdict(done.returncode, done.stdout, pins)
    sys.stdout.write(words + "\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
