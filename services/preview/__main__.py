"""``python -m services.preview`` is ``treedock preview``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "preview")
main()
