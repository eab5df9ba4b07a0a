"""Arrays as a stage declares them: what is written, and explained, is made from the declaration.

A stage has a table ``ARRAYS`` by name: unit, axes, meaning. ± behind the unit says that the product holds
errors beside it. Of a name in angle brackets there are several: recordings, effects, curves. A table
``CHECKS`` has, by name, what is checked, and the key of the settings that holds its limit, if one does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.product.quantity import Quantity

Arrays = Mapping[str, tuple[str, str, str]]  # unit, axes, meaning
Checks = Mapping[str, tuple[str, str]]  # meaning, key of the limit
ANY_OF = re.compile(r"<[^>]*>")


def declared(
    arrays: Arrays, values: Mapping[str, Any], note: str = "", *, below: str = ""
) -> dict[str, Quantity]:
    """Return `values` as arrays of a product, with what a stage's table `arrays` says of them.

    Parameters
    ----------
    arrays : mapping
    values : mapping
        Arrays by name; where the table has ±, an array and its standard error.
    note : str
        Added to the meaning of these values.
    below : str
        What their names begin with: the group of the product that they lie in.

    Raises
    ------
    KeyError
        For a name that the table has not.
    """
    found = {}
    for name, given in values.items():
        unit, axes, text = arrays[name_in(arrays, name) or name]
        value, error = given if unit.endswith("±") else (given, None)
        shape = f" ({axes})" if "," in axes else ""
        text = f"{text}{shape}{'; ' if note else ''}{note}"
        found[below + name] = Quantity(np.asarray(value), unit.removesuffix("±").strip(), text, error)
    return found


def name_in(arrays: Arrays, name: str) -> str | None:
    """Return the name under which a table of `arrays` has the array `name`, or None."""
    if name in arrays:
        return name
    patterns = {known: ".+".join(map(re.escape, ANY_OF.split(known))) for known in arrays if "<" in known}
    return next((known for known, pattern in patterns.items() if re.fullmatch(pattern, name)), None)
