"""An array with its unit, error and description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from astropy.nddata import NDData
    from astropy.units import UnitBase

# Units as products spell them, where Astropy spells them otherwise.
SPELLINGS = {"e-": "electron", "e-2": "electron2", "ADU": "adu", "ADU2": "adu2", "px": "pix"}


@dataclass(frozen=True)
class Quantity:
    """An array with its unit.

    Attributes
    ----------
    value : ndarray
        Numbers, booleans or strings, of any shape (scalars included).
    unit : str
        Unit as text, for example ``nm``; empty for dimensionless values and strings.
    error : ndarray or None
        1-sigma error in the same unit and of the same shape.

    Raises
    ------
    ValueError
        When value and error differ in shape.
    """

    value: np.ndarray
    unit: str
    description: str = ""
    error: np.ndarray | None = None

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
        """Shape, unit and description, in words."""
        shape = "×".join(map(str, np.shape(self.value))) or "scalar"
        unit = f"{self.unit} ± error" if self.error is not None else self.unit
        return shape, unit.strip(), self.description

    def __repr__(self) -> str:
        """Return shape, unit and description."""
        shape, unit, description = self.described
        return f"<Quantity {' '.join(filter(None, [shape, unit]))}: {description}>"
