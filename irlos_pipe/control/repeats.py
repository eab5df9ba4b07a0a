"""Pixels that come again: two reads of a detector are never the same to the last bit, be it in a part."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from functools import cache

import numpy as np

PATCH_PX = 8  # side: noise of a few steps of the converter never gives 64 pixels twice
PART = 0.125  # of the patches that vary, from which a read is a repetition
REMEMBERED = 1000  # reads


@dataclass
class Repeats:
    """Remembers patches of recent reads by a number of 64 bits each."""

    _reads: deque[list[int]] = field(default_factory=deque)
    _seen: set[int] = field(default_factory=set)

    def has(self, image: np.ndarray) -> bool:
        """Return whether a part of an `image`, (rows, columns), has been there before; remember it.

        Patches without any structure, as of a masked or saturated region, do not count.
        """
        keys = _keys(image)
        known = sum(key in self._seen for key in keys)
        self._reads.append(keys)
        self._seen.update(keys)
        if len(self._reads) > REMEMBERED:
            self._seen.difference_update(self._reads.popleft())
        return known > 0 and known >= PART * len(keys)


def _keys(image: np.ndarray) -> list[int]:
    bits = np.ascontiguousarray(image, np.float32).view(np.uint32)
    rows, columns = (max(1, size // PATCH_PX) for size in bits.shape)
    height, width = bits.shape[0] // rows, bits.shape[1] // columns
    if not height or not width:
        return []
    patches = bits[: rows * height, : columns * width].reshape(rows, height, columns, width)
    flat = patches.swapaxes(1, 2).reshape(rows * columns, height * width)
    varied = (flat != flat[:, :1]).any(axis=1)
    by_pixel, by_patch = _random_bits(height * width), _random_bits(rows * columns)
    return (flat.astype(np.uint64) @ by_pixel + by_patch)[varied].tolist()


@cache
def _random_bits(count: int) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 1 << 64, count, np.uint64) | np.uint64(1)
