"""The truth of a simulated recording: what an estimate is compared with, kept apart from the data."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.simulate.exposure import LAST_NOLL, Exposure, telescope_of
from irlos_pipe.simulate.recordings.planned import Planned
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.wavefront import static_zernike_nm

VERSION = 2  # of the simulator; raised when the same spec and seed give other data or another truth


class WavefrontTruth:
    """Gathers the wavefront of a recording while it is exposed, diversity excluded.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._telescope = telescope_of(scene)
        self._sum_nm = np.zeros_like(self._telescope.transmission)
        self._zernike_nm: list[np.ndarray] = []

    def add(self, exposure: Exposure) -> None:
        """Take one more `exposure`."""
        introduced_nm = self._scene.introduced_per_frame_nm[len(self._zernike_nm)]
        opd_nm = exposure.opd_nm + introduced_nm * self._telescope.mode(DEFOCUS)
        self._sum_nm += opd_nm
        self._zernike_nm.append(self._telescope.fit_zernike_nm(opd_nm, LAST_NOLL, exposure.stated_nm))

    @property
    def mean_opd_nm(self) -> np.ndarray:
        """Average over the frames, introduced defocus included, (n, n) [nm]."""
        return self._sum_nm / len(self._zernike_nm)

    def mean_zernike_nm(self) -> dict[int, float]:
        """Noll 2..31 of the average, see `Exposed.zernike_nm`: nm RMS."""
        return dict(enumerate(np.mean(self._zernike_nm, axis=0).tolist(), start=2))

    def fits_bytes(self) -> bytes:
        """FITS file: mean OPD (NaN outside the pupil), transmission, coefficients per frame."""
        lit = self._telescope.transmission > 0
        opd = fits.PrimaryHDU(np.where(lit, self.mean_opd_nm, np.nan).astype(np.float32))
        opd.header["BUNIT"] = ("nm", "mean OPD without the diversity")
        opd.header["STEP"] = (self._telescope.step_m, "[m] between samples; the axis is at the centre")
        pupil = fits.ImageHDU(self._telescope.transmission.astype(np.float32), name="TRANSMISSION")
        modes = fits.ImageHDU(np.array(self._zernike_nm), name="ZERNIKE")
        modes.header["BUNIT"] = ("nm", "RMS; frames x Noll 2..31")
        stream = BytesIO()
        fits.HDUList([opd, pupil, modes]).writeto(stream)
        return stream.getvalue()


def truth_content(planned: Planned, wavefront: WavefrontTruth) -> dict[str, Any]:
    """Return the content of the truth file of a `planned` recording with its `wavefront`.

    ``ncpa_nm`` are the static modes that the scene states, with those of its effects and the error of the
    diversity; ``mean_zernike_nm`` is what an estimate is compared with: the time-averaged wavefront,
    introduced defocus included as the stage reached it, diversity excluded.
    """
    scene = planned.scene
    return {
        "hidden": planned.hidden,
        "ncpa_nm": dict(sorted(static_zernike_nm(scene).items())),
        "introduced_defocus_nm": planned.commanded_nm,
        "reached_defocus_nm": scene.introduced_nm,
        "mean_zernike_nm": wavefront.mean_zernike_nm(),
        "photons_per_frame": scene.photons,
        "residual_wfe_nm": scene.residual_wfe_nm,
        "simulation": made_from(planned),
    }


def made_from(planned: Planned) -> dict[str, Any]:
    """Return all that a `planned` recording depends on, in JSON types."""
    return jsonable({"version": VERSION, "recording": planned})


def write_truth(path: Path, content: dict[str, Any], wavefront_fits: bytes) -> None:
    """Write `content` to ``<path>.json`` and `wavefront_fits` to ``<path>_wavefront.fits``.

    The JSON is written last: it marks that all is there. `path` has no suffix.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path.with_name(f"{path.name}_wavefront.fits"), wavefront_fits)
    write_bytes(path.with_name(f"{path.name}.json"), json_text(content).encode())
