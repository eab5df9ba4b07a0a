"""What the PSF model has to know of the instrument and of its own sampling."""

from __future__ import annotations

from dataclasses import dataclass

from irlos_pipe.conventions.pupil import PupilGeometry


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
    diversity : dict of int to float
        Noll index to nm RMS, always present in the light path.
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
    diversity: dict[int, float]
    pupil_samples: int = 128
    margin_mas: float = 200.0
    halo_margin_mas: float = 500.0
