"""``python -m services.station`` is ``treedock station``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "station")
main()
