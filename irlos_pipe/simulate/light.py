"""Light of a scene: pass-bands, and rays of one wavelength from one source."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.bands import Passband
from irlos_pipe.conventions.keys import key
from irlos_pipe.simulate import SceneError


@dataclass(frozen=True)
class Band(Passband):
    """A pass-band, and its `share` of the photons.

    J and H are the boxes of `irlos_pipe.conventions.bands`, whose half widths of 58 and 84 nm are rounded:
    with 58.09 and 83.91 nm three Gauss–Legendre nodes would lie at 1170, 1215, 1260 and 1560, 1625, 1690 nm.
    """

    share: float = key(1.0, "photons, any scale", gt=0, le=1e6)

    def __post_init__(self) -> None:
        if self.half_width_nm > self.centre_nm / 2:
            raise SceneError("half_width_nm is more than half of centre_nm")

    @classmethod
    def of(cls, passband: Passband, share: float = 1.0) -> "Band":
        """Return a `passband` with its `share` of the photons."""
        return cls(passband.centre_nm, passband.half_width_nm, share)


def mean_centre_nm(bands: Sequence[Band]) -> float:
    """Return the photon-weighted mean of the centres of `bands` [nm]."""
    return sum(band.share * band.centre_nm for band in bands) / sum(band.share for band in bands)


@dataclass(frozen=True)
class Ray:
    """Light of one wavelength from one source, `weight` photons in parts of the star's.

    Its image lies at `offset_mas`, (x, y) from the optical axis, and has `defocus_nm` of Noll 4 beyond that
    of the star [nm RMS].
    """

    wavelength_nm: float
    weight: float
    offset_mas: tuple[float, float] = (0.0, 0.0)
    defocus_nm: float = 0.0

    @property
    def pupil(self) -> tuple[float, float]:
        """Wavelength and defocus, by which the amplitude in the pupil differs."""
        return self.wavelength_nm, self.defocus_nm

    def moved(self, distance_mas: float, angle_deg: float) -> "Ray":
        """Return the ray displaced by `distance_mas` towards `angle_deg`, counted from +x towards +y."""
        angle = np.deg2rad(angle_deg)
        steps_mas = (distance_mas * float(np.cos(angle)), distance_mas * float(np.sin(angle)))
        x_mas, y_mas = (start + step for start, step in zip(self.offset_mas, steps_mas, strict=True))
        return replace(self, offset_mas=(x_mas, y_mas))
