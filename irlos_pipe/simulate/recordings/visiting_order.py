"""In which order the focus stage visits its offsets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def visiting_order(offsets_nm: Sequence[float], order: str) -> list[int]:
    """Return the indices of `offsets_nm` in the `order` of recording.

    ``ping_pong`` goes from the ends inwards and changes side after every offset, so that
    successive offsets are reached from opposite directions; ``as_given`` keeps the list.
    """
    if order == "as_given":
        return list(range(len(offsets_nm)))
    ascending = np.argsort(offsets_nm, kind="stable").tolist()
    inwards = [index for pair in zip(ascending, reversed(ascending), strict=True) for index in pair]
    return inwards[: len(ascending)]
