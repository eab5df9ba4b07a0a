"""The photometric bands of IRLOS, as boxes [nm]."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Passband:
    """A box filter.

    Attributes
    ----------
    centre_nm, half_width_nm : float
        Middle of the box, and its distance to either end [nm].
    """

    centre_nm: float
    half_width_nm: float

    @property
    def limits_nm(self) -> tuple[float, float]:
        """Return the first and the last wavelength that pass [nm]."""
        return self.centre_nm - self.half_width_nm, self.centre_nm + self.half_width_nm


J = Passband(1215.0, 58.0)
H = Passband(1625.0, 84.0)
NARROW_H = Passband(1600.0, 20.0)
