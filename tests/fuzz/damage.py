"""Damage as a strategy: a sound file or message, and a few edits that hypothesis can shrink to the one that matters."""

from __future__ import annotations

import os
from collections.abc import Sequence

from hypothesis import strategies as st

CASES = int(os.environ.get("TREEDOCK_FUZZ", "0")) or 25
"""Cases per target: short in CI; ``TREEDOCK_FUZZ=20000 pytest tests/fuzz`` for a night."""

Edit = tuple[str, float, int, bytes]
"""What, where (share of the length), how long, with which bytes."""

_WIDE = st.sampled_from(
    [b"\xff" * 8, b"\x00" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80", b"-1", b"nan", b"1e999"]
)
_EDIT = st.tuples(
    st.sampled_from(["put", "insert", "remove", "repeat", "cut"]), st.floats(0.0, 1.0), st.integers(1, 64),
    st.one_of(st.binary(min_size=1, max_size=8), _WIDE),
)  # fmt: skip


def damaged(seeds: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """Return the strategy: one of the seeds with one to four edits, or any bytes at all."""
    made = st.tuples(st.sampled_from(seeds), st.lists(_EDIT, min_size=1, max_size=4)).map(_apply)
    return st.one_of(made, made, made, st.binary(max_size=300))


def _apply(item: tuple[bytes, list[Edit]]) -> bytes:
    data, edits = bytearray(item[0]), item[1]
    for what, share, length, put in edits:
        at = round(share * max(0, len(data) - 1))
        if what == "put":
            data[at : at + len(put)] = put
        elif what == "insert":
            data[at:at] = put
        elif what == "remove":
            del data[at : at + length]
        elif what == "repeat":
            data[at:at] = data[at : at + length]
        else:
            del data[at:]
    return bytes(data)
