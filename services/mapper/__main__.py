"""``python -m services.mapper`` is ``treedock mapper``."""

from __future__ import annotations

import sys

from services.cli.app import main

sys.argv.insert(1, "mapper")
main()
