"""Write the golden bytes of message versions that have none yet; existing files are never changed.

Run as ``python -m tests.golden.write`` after adding a message or raising a VERSION.
"""

from __future__ import annotations

import sys
from pathlib import Path

from schemas.codec import encode
from tests.examples import all_messages

FOLDER = Path(__file__).parent / "messages"


def main() -> None:
    """Write what is missing."""
    FOLDER.mkdir(exist_ok=True)
    for example in all_messages().values():
        path = FOLDER / f"{example.SCHEMA}@{example.VERSION}.bin"  # type: ignore[attr-defined]
        if not path.exists():
            path.write_bytes(bytes(encode(example)))
            sys.stderr.write(f"wrote {path}\n")


if __name__ == "__main__":
    main()
