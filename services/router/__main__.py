"""``python -m services.router`` is ``treedock router``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "router")
main()
