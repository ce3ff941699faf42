"""Binary descriptors of 256 bits as four uint64: Hamming distance in one instruction per word."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

U64 = NDArray[np.uint64]

WORDS = 4


@intrinsic
def popcount(typing_context: object, word: object) -> object:
    """Return the number of ones in a uint64 (compiled code only)."""
    del typing_context, word

    def codegen(context: object, builder: Any, signature: object, args: Any) -> object:  # noqa: ANN401 - llvmlite's
        del context, signature
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


@njit(cache=True, nogil=True)
def hamming(a: U64, b: U64) -> int:
    """Return the number of bits in which two descriptors (4,) differ."""
    total = np.uint64(0)
    for k in range(WORDS):
        total += popcount(a[k] ^ b[k])  # type: ignore[call-arg]
    return int(total)


@njit(cache=True, nogil=True)
def match_all(query: U64, train: U64, max_distance: int, ratio: float) -> NDArray[np.int32]:
    """Return for each query the nearest train index, or -1 when too far, ambiguous, or nearer to another query."""
    n = len(query)
    match = np.full(n, -1, np.int32)
    owner_distance = np.full(len(train), 1000, np.int32)
    owner = np.full(len(train), -1, np.int32)
    for i in range(n):
        best, second, index = 1000, 1000, -1
        for j in range(len(train)):
            distance = hamming(query[i], train[j])
            if distance < best:
                best, second, index = distance, best, j
            elif distance < second:
                second = distance
        if index < 0 or best > max_distance or best > ratio * second:
            continue
        if best < owner_distance[index]:
            if owner[index] >= 0:
                match[owner[index]] = -1
            owner[index], owner_distance[index] = i, best
            match[i] = index
    return match
