"""The photometric bands of IRLOS, as boxes [nm]."""

from dataclasses import dataclass

from irlos_pipe.conventions.keys import key


@dataclass(frozen=True)
class Passband:
    """A box filter: the middle of the box, and its distance to either end."""

    centre_nm: float = key(meaning="centre", ge=500, le=5000)
    half_width_nm: float = key(meaning="half its width", ge=0, le=1000)

    @property
    def limits_nm(self) -> tuple[float, float]:
        """Return the first and the last wavelength that pass [nm]."""
        return self.centre_nm - self.half_width_nm, self.centre_nm + self.half_width_nm


J = Passband(1215.0, 58.0)
H = Passband(1625.0, 84.0)
NARROW_H = Passband(1600.0, 20.0)
