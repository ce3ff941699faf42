"""``python -m services.navigator.autopilot`` is ``treedock autopilot``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "autopilot")
main()
