"""Which keyframes look like this image: bags of words of the living keyframes, scored one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.slam.vocabulary import Vocabulary, score_bags

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

Bag = tuple[I32, F64]


class Places:
    """The bags of keyframes by their serial."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.vocabulary = vocabulary
        self._bags: dict[int, Bag] = {}

    def add(self, serial: int, desc: NDArray[np.uint64]) -> Bag:
        """Remember a keyframe; return its bag."""
        self._bags[serial] = self.vocabulary.bag(desc)
        return self._bags[serial]

    def keep_only(self, serials: set[int]) -> None:
        """Forget the keyframes that are not among ``serials``."""
        for serial in [s for s in self._bags if s not in serials]:
            del self._bags[serial]

    def scores(self, bag: Bag) -> dict[int, float]:
        """Return the similarity 0..1 of each keyframe with a bag."""
        if not self._bags:
            return {}
        query = np.zeros(len(self.vocabulary.weight))
        query[bag[0]] = bag[1]
        start = np.zeros(len(self._bags) + 1, np.int32)
        start[1:] = np.cumsum([len(words) for words, _ in self._bags.values()])
        words = np.concatenate([words for words, _ in self._bags.values()])
        weights = np.concatenate([weights for _, weights in self._bags.values()])
        values = score_bags(query, words, weights, start)
        return dict(zip(self._bags, (float(v) for v in values), strict=True))
