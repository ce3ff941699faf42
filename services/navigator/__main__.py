"""``python -m services.navigator`` is ``treedock navigator``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "navigator")
main()
