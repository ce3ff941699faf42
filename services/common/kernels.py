"""Small numerical kernels that several services share; each is compiled into the kernels that call it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@njit(cache=True, nogil=True)
def solve_positive(A: Floats, y: Floats, x: Floats) -> None:
    """Solve a small symmetric positive definite system by Cholesky; ``A`` is overwritten.

    A pivot that is not positive is taken as 1e-18: the answer is then large, never NaN.
    """
    n = y.shape[0]
    for i in range(n):
        for j in range(i + 1):
            v = A[i, j]
            for k in range(j):
                v -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = np.sqrt(max(v, 1e-18))
            else:
                A[i, j] = v / A[j, j]
    for i in range(n):
        v = y[i]
        for k in range(i):
            v -= A[i, k] * x[k]
        x[i] = v / A[i, i]
    for i in range(n - 1, -1, -1):
        v = x[i]
        for k in range(i + 1, n):
            v -= A[k, i] * x[k]
        x[i] = v / A[i, i]


@njit(cache=True, nogil=True)
def slot_of(table: NDArray[np.int32], keys: NDArray[np.int64], key: np.int64) -> np.int64:
    """Return the slot of ``key`` in an open-addressing table (-1: free), or of the free place where it belongs.

    ``table`` holds positions in ``keys``; its length is a power of two.
    """
    mask = np.int64(table.shape[0] - 1)
    at = (key * np.int64(-7046029254386353131) >> 20) & mask
    while table[at] >= 0 and keys[table[at]] != key:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def root_of(parent: NDArray[np.int64], a: int) -> int:
    """Return the root of ``a`` in a union-find forest, halving the path."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a
