"""``python -m services.detector`` is ``treedock detector``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "detector")
main()
