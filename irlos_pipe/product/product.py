"""The product of a stage: arrays with units and errors, results, QC, configuration, provenance.

A stage declares its arrays and checks: what is written, and explained, is made from the declaration. A table
``ARRAYS`` has by name unit, axes and meaning. ± behind the unit says that the product also holds its errors.
Of a name in angle brackets there are several: recordings, effects, curves. A table ``CHECKS`` has, by name,
what is checked, and the key of the settings that holds its limit, if one does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.keys import NullIsNan
from irlos_pipe.conventions.text import aligned, suggestion

if TYPE_CHECKING:
    from astropy.nddata import NDData
    from astropy.table import QTable
    from astropy.units import UnitBase

# Units as products spell them, where Astropy spells them otherwise.
SPELLINGS = {"e-": "electron", "e-2": "electron2", "ADU": "adu", "ADU2": "adu2", "px": "pix"}

SHOWN = 12  # arrays that the text of a product names at most
ANY_OF = re.compile(r"<[^>]*>")


@dataclass(frozen=True)
class Quantity:
    """An array with its unit; `ValueError` when value and error differ in shape."""

    value: np.ndarray  # numbers, booleans or strings, of any shape (scalars included)
    unit: str  # as text, for example ``nm``; empty for dimensionless values and strings
    description: str = ""
    error: np.ndarray | None = None  # 1-sigma error in the same unit and of the same shape

    def __post_init__(self) -> None:
        if self.error is not None and np.shape(self.error) != np.shape(self.value):
            raise ValueError(f"error has shape {np.shape(self.error)}, value {np.shape(self.value)}")

    def nddata(self) -> NDData:
        """Return it as `astropy.nddata.NDData`, the error as standard deviation."""
        from astropy.nddata import NDData, StdDevUncertainty

        error = None if self.error is None else StdDevUncertainty(self.error)
        meta = {"description": self.description}
        return NDData(np.asarray(self.value), uncertainty=error, unit=self.astropy_unit, meta=meta)

    @property
    def astropy_unit(self) -> UnitBase | None:
        """The unit as Astropy has it, or as a name where it has none (D/λ); None for words and flags."""
        from astropy import units

        if np.asarray(self.value).dtype.kind not in "iufc":
            return None
        return units.Unit(SPELLINGS.get(self.unit, self.unit), parse_strict="silent")

    @property
    def described(self) -> tuple[str, str, str]:
        shape = "×".join(map(str, np.shape(self.value))) or "scalar"
        unit = f"{self.unit} ± error" if self.error is not None else self.unit
        return shape, unit.strip(), self.description

    def __repr__(self) -> str:
        shape, unit, description = self.described
        return f"<Quantity {' '.join(filter(None, [shape, unit]))}: {description}>"


@dataclass(frozen=True)
class Check:
    """One quality-control check: a value and the limits it must keep."""

    name: str
    value: Annotated[int | float, NullIsNan()]
    unit: str
    low: int | float | None
    high: int | float | None
    message: str

    @property
    def beyond(self) -> bool:
        """Whether the value lies outside of the limits."""
        below = self.low is not None and self.value < self.low
        return bool(below or (self.high is not None and self.value > self.high))

    @property
    def passed(self) -> bool:
        """True inside the limits; a NaN never passes."""
        return not (self.beyond or np.isnan(self.value))

    def because(self, why: str) -> Check:
        """Return the check with the reason `why` behind its message, where its value is beyond a limit."""
        return replace(self, message=f"{self.message}: {why}") if self.beyond else self

    @property
    def limits(self) -> str:
        """The limits as text, empty if there are none."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} … {self.high:g}"
        if self.low is not None:
            return f"≥ {self.low:g}"
        return f"≤ {self.high:g}" if self.high is not None else ""

    def as_dict(self) -> dict[str, Any]:
        """Return the check as it stands in qc.json."""
        return {"name": self.name, "passed": self.passed} | asdict(self)


@dataclass(frozen=True)
class Product:
    stage: str
    arrays: Mapping[str, Quantity]  # names may contain ``/``, which makes HDF5 groups
    results: dict[str, Any]  # the stage's section of results.json
    checks: list[Check] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    @property
    def summary(self) -> list[str]:
        return list(self.provenance.get("summary", ()))

    def __getitem__(self, name: str) -> Quantity:
        return self.arrays[name]

    def table(self, *names: str) -> QTable:
        """Return arrays of equal length as an `astropy.table.QTable` with units.

        By default these are all arrays of one dimension that have the length of the first of them. An error
        becomes the column ``<name>_error``.

        Raises `ConfigurationError` when an array is unknown, or the lengths differ.
        """
        from astropy.table import QTable

        arrays = self.arrays
        for name in names:
            if name not in arrays:
                raise ConfigurationError(
                    f"no array '{name}' in the product of '{self.stage}'{suggestion(name, arrays)}"
                )
        chosen = list(names) or _of_first_length(arrays)
        lengths = {name: len(np.atleast_1d(arrays[name].value)) for name in chosen}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ConfigurationError(f"arrays of different lengths do not fit into one table: {told}")
        table = QTable(meta={"stage": self.stage})
        for name in chosen:
            quantity = arrays[name]
            from astropy.units import Quantity as WithUnit

            unit = quantity.astropy_unit
            for label, values in ((name, quantity.value), (f"{name}_error", quantity.error)):
                if values is not None:
                    column = np.atleast_1d(values)
                    plain = unit is None or (column.dtype.kind in "iu" and not quantity.unit)  # as an index
                    table[label] = column if plain else WithUnit(column, unit)
                    table[label].info.description = quantity.description
        return table

    def __repr__(self) -> str:
        passed = sum(check.passed for check in self.checks)
        head = f"Product of '{self.stage}': {passed} of {len(self.checks)} checks passed"
        names = list(self.arrays)
        rows = [(f"  {name}", *self.arrays[name].described) for name in names[:SHOWN]]
        more = [f"  … and {len(names) - SHOWN} more arrays"] if len(names) > SHOWN else []
        return "\n".join([head, *(f"  {line}" for line in self.summary), aligned(rows), *more])


Arrays = Mapping[str, tuple[str, str, str]]  # unit, axes, meaning
Checks = Mapping[str, tuple[str, str]]  # meaning, key of the limit


def declared(
    arrays: Arrays, values: Mapping[str, Any], note: str = "", *, below: str = ""
) -> dict[str, Quantity]:
    """Return `values` as arrays of a product, with what a stage's table `arrays` says of them.

    `values` has arrays by name; where the table has ±, an array and its standard error. `note` is added to
    the meaning of these values, and their names begin with `below`, the group of the product they lie in.

    Raises `KeyError` for a name that the table has not.
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


def _of_first_length(arrays: Mapping[str, Quantity]) -> list[str]:
    flat = [name for name, one in arrays.items() if np.ndim(one.value) == 1]
    return [name for name in flat if len(arrays[name].value) == len(arrays[flat[0]].value)]
