"""``python -m services.fusion`` is ``treedock fusion``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "fusion")
main()
