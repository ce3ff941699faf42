"""A tree of binary words: an image as the few hundred words its descriptors fall on, for recognising a place.

Galvez-Lopez and Tardos, "Bags of binary words for fast place recognition in image sequences" (2012). The tree shipped beside
this file was grown by ``train`` on recordings and simulated forests.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.binary import hamming

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]

_FILE = Path(__file__).with_name("vocabulary.npz")
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """A complete tree: node 0 is the root, the children of node n are ``branching`` * n + 1 and on."""

    centre: U64
    """(nodes, 4) descriptor of each node; empty branches repeat a sibling."""
    weight: F64
    """(words,) inverse document frequency."""
    branching: int
    depth: int

    def words(self, desc: U64) -> I32:
        """Return the word (N,) of each descriptor (N, 4)."""
        return quantise(self.centre, desc, self.branching, self.depth)

    def bag(self, desc: U64) -> tuple[I32, F64]:
        """Return the words of an image, ascending, with their weights, which sum to one."""
        words, counts = np.unique(self.words(desc), return_counts=True)
        weights = counts * self.weight[words]
        total = float(weights.sum())
        return words.astype(np.int32), weights / total if total > 0.0 else weights


def load() -> Vocabulary:
    """Return the vocabulary shipped with slam."""
    with np.load(_FILE) as data:
        return Vocabulary(data["centre"], data["weight"].astype(float), int(data["branching"]), int(data["depth"]))


@njit(cache=True, nogil=True)
def quantise(centre: U64, desc: U64, branching: int, depth: int) -> I32:
    """Return the leaf (N,), counted from the first leaf, that each descriptor falls on."""
    first_leaf = 0
    width = 1
    for _ in range(depth):
        first_leaf += width
        width *= branching
    out = np.empty(len(desc), np.int32)
    for i in range(len(desc)):
        node = 0
        for _ in range(depth):
            best, child = 1000, 0
            for c in range(branching * node + 1, branching * node + 1 + branching):
                distance = hamming(centre[c], desc[i])
                if distance < best:
                    best, child = distance, c
            node = child
        out[i] = node - first_leaf
    return out


@njit(cache=True, nogil=True)
def score_bags(query: F64, words: I32, weights: F64, start: I32) -> F64:
    """Return the similarity 0..1 of a dense query (words,) with each stored bag: the sum of the lesser weights.

    For bags of sum one this is the L1 score of the paper, 1 - |a - b| / 2.
    """
    out = np.zeros(len(start) - 1)
    for b in range(len(out)):
        total = 0.0
        for k in range(start[b], start[b + 1]):
            total += min(query[words[k]], weights[k])
        out[b] = total
    return out


@njit(cache=True, nogil=True)
def assign(centre: U64, desc: U64) -> I32:
    """Return the nearest centre (N,) of each descriptor."""
    out = np.empty(len(desc), np.int32)
    for i in range(len(desc)):
        best = 1000
        for c in range(len(centre)):
            distance = hamming(centre[c], desc[i])
            if distance < best:
                best, out[i] = distance, c
    return out


def cluster(desc: U64, count: int, rng: np.random.Generator) -> tuple[U64, I32]:
    """Return ``count`` majority centres (count, 4) of descriptors and each one's cluster (k-means in Hamming space)."""
    pick = rng.choice(len(desc), size=count, replace=len(desc) < count)
    centre = desc[np.sort(pick)].copy()
    member = assign(centre, desc)
    bits = np.unpackbits(desc.view(np.uint8), axis=1)
    for _ in range(_ROUNDS):
        for c in range(count):
            own = bits[member == c]
            if len(own):
                centre[c] = np.packbits(own.mean(axis=0) >= 0.5).view(np.uint64)
        renewed = assign(centre, desc)
        if np.array_equal(renewed, member):
            break
        member = renewed
    return centre, member


def train(images: list[U64], branching: int, depth: int, seed: int) -> Vocabulary:
    """Grow a vocabulary on the descriptors (N, 4) of many images."""
    rng = np.random.default_rng(seed)
    desc = np.concatenate(images)
    inner = (branching**depth - 1) // (branching - 1)
    centre = np.zeros((inner + branching**depth, 4), np.uint64)
    member: dict[int, NDArray[np.int64]] = {0: np.arange(len(desc))}
    for node in range(inner):
        own = member.pop(node)
        first = branching * node + 1
        if not len(own):
            centre[first : first + branching] = centre[node]
            member |= {first + c: own for c in range(branching)}
            continue
        centre[first : first + branching], which = cluster(desc[own], branching, rng)
        member |= {first + c: own[which == c] for c in range(branching)}
    flat = Vocabulary(centre, np.ones(branching**depth), branching, depth)
    seen = np.zeros(branching**depth)
    for image in images:
        seen[np.unique(flat.words(image))] += 1.0
    weight = np.log(len(images) / np.maximum(seen, 1.0))
    return Vocabulary(centre, weight, branching, depth)


def save(vocabulary: Vocabulary) -> None:
    """Write the vocabulary that ``load`` reads."""
    np.savez_compressed(
        _FILE, centre=vocabulary.centre, weight=vocabulary.weight.astype(np.float32),
        branching=vocabulary.branching, depth=vocabulary.depth,
    )  # fmt: skip
