"""``python -m services.simulator`` is ``treedock simulator``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "simulator")
main()
