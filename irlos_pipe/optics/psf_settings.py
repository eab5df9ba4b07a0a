"""What the PSF model has to know of the instrument and of its own sampling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from irlos_pipe.conventions.pupil import PupilGeometry


@dataclass(frozen=True)
class KnownWavefront:
    """What is known of the wavefront before anything is estimated: Noll index to nm RMS.

    Attributes
    ----------
    diversity_nm : mapping of int to float
        The astigmatism introduced for phase diversity.
    introduced_nm : mapping of int to float
        What was introduced on purpose beside it: the defocus commanded of the focus stage.
    ncpa_nm : mapping of int to float
        NCPAs estimated before and held here.
    """

    diversity_nm: Mapping[int, float] = field(default_factory=dict)
    introduced_nm: Mapping[int, float] = field(default_factory=dict)
    ncpa_nm: Mapping[int, float] = field(default_factory=dict)

    @property
    def total_nm(self) -> dict[int, float]:
        """The sum of the three, by Noll index [nm RMS]."""
        total = dict(self.diversity_nm)
        for part in (self.introduced_nm, self.ncpa_nm):
            for noll, nm in part.items():
                total[noll] = total.get(noll, 0.0) + nm
        return total


@dataclass(frozen=True)
class PsfSettings:
    """Everything about the instrument and its sampling that a `PsfModel` needs.

    Attributes
    ----------
    geometry : PupilGeometry
    window : (int, int)
        Rows and columns of the detector window [px].
    pixel_scale_mas : float
    spectrum : sequence of (wavelength_nm, weight)
        Photon weights, any positive scale.
    known : KnownWavefront
        Present in every image, beside the coefficients that the model is given.
    pupil_samples : int
        Samples across the pupil diameter; 128 keeps the error below 1e-4 of the peak for
        wavefronts up to 600 nm RMS (tests/test_psf_accuracy.py).
    margin_mas : float
        Field computed beyond the window on each side. The end of the field rings into the
        window when the intensity is interpolated to the pixels: with 100 mas by 1e-5 of a compact
        peak and 2e-4 of one spread to the window's edge, with 200 mas by 2e-6 and 5e-5.
    halo_margin_mas : float
        The same for the period of the OTF factors, whose wings are wider.
    """

    geometry: PupilGeometry
    window: tuple[int, int]
    pixel_scale_mas: float
    spectrum: tuple[tuple[float, float], ...]
    known: KnownWavefront
    pupil_samples: int = 128
    margin_mas: float = 200.0
    halo_margin_mas: float = 500.0
