"""``python -m services.recorder`` is ``treedock recorder``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "recorder")
main()
