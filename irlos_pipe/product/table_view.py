"""Arrays of a product as a table of Astropy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.product.quantity import Quantity

if TYPE_CHECKING:
    from astropy.table import QTable


def table_of(stage: str, arrays: Mapping[str, Quantity], names: Sequence[str] = ()) -> QTable:
    """Return arrays of equal length as the columns of an `astropy.table.QTable`.

    Parameters
    ----------
    stage : str
        Whose arrays they are.
    arrays : mapping of str to Quantity
    names : sequence of str
        Arrays of one dimension or more, whose first is that of the rows; by default all of one dimension
        that have the length of the first of them. An error becomes the column ``<name>_error``.

    Raises
    ------
    ConfigurationError
        When an array is unknown, or the lengths differ.
    """
    from astropy.table import QTable

    for name in names:
        if name not in arrays:
            raise ConfigurationError(
                f"no array '{name}' in the product of '{stage}'{suggestion(name, arrays)}"
            )
    chosen = list(names) or _alike(arrays)
    lengths = {name: len(np.atleast_1d(arrays[name].value)) for name in chosen}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ConfigurationError(f"arrays of different lengths do not fit into one table: {told}")
    table = QTable(meta={"stage": stage})
    for name in chosen:
        _add(table, name, arrays[name])
    return table


def _alike(arrays: Mapping[str, Quantity]) -> list[str]:
    """The arrays of one dimension that have the length of the first."""
    flat = [name for name, one in arrays.items() if np.ndim(one.value) == 1]
    return [name for name in flat if len(arrays[name].value) == len(arrays[flat[0]].value)]


def _add(table: QTable, name: str, quantity: Quantity) -> None:
    from astropy.units import Quantity as WithUnit

    unit = quantity.astropy_unit
    for label, values in ((name, quantity.value), (f"{name}_error", quantity.error)):
        if values is not None:
            column = np.atleast_1d(values)
            plain = unit is None or (column.dtype.kind in "iu" and not quantity.unit)  # as an index
            table[label] = column if plain else WithUnit(column, unit)
            table[label].info.description = quantity.description
