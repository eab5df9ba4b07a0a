"""Images of the UT4 pupil and others by HCIPy, on a grid eight times finer than the project's default.

Shares no code with the package: HCIPy's aperture, Zernikes and matrix Fourier transform, the pupil's
geometry as written in the simulator of ``data_samples``, pixels integrated by Gauss-Legendre rules.
"""

import functools

import numpy as np
import pytest

hcipy = pytest.importorskip("hcipy", reason="the independent images need HCIPy, a development dependency")
from simulator.telescope import (  # noqa: E402
    OBSCURATION_M,
    VANE_ORIGIN_M,
    VANE_TIP_M,
    VANE_WIDTH_M,
    ut4_aperture,
)

DIAMETER_M = 8.0
MAS_RAD = np.deg2rad(1 / 3.6e6)
NODES = 4  # per pixel and axis
SUBSAMPLES = 4  # per side of a pupil cell


class ReferenceImager:
    """Point-source images, as fractions of the light through the pupil.

    The grid has so many `samples` across its `width_m`, by default `diameter_m`, that of the disc on which
    Zernikes have unit RMS; `aperture` is HCIPy's field generator of the pupil.
    """

    def __init__(
        self, samples: int = 1024, aperture=ut4_aperture, diameter_m: float = DIAMETER_M, width_m=None
    ):
        self.grid = hcipy.make_pupil_grid(samples, width_m or diameter_m)
        self.step_m, self._diameter_m = float(self.grid.delta[0]), diameter_m
        self.transmission = _supersampled(self.grid, self.step_m, aperture)
        self.area_m2 = float(self.transmission.sum()) * self.step_m**2
        self._mode = functools.cache(self._mode)

    def _mode(self, noll: int) -> np.ndarray:
        n, m = hcipy.noll_to_zernike(noll)
        return np.asarray(hcipy.zernike(n, m, D=self._diameter_m, grid=self.grid, radial_cutoff=False))

    def opd_nm(self, zernike_nm: dict[int, float]) -> np.ndarray:
        """OPD of Noll coefficients, flat [nm]."""
        return sum((nm * self._mode(noll) for noll, nm in zernike_nm.items()), np.zeros(self.grid.size))

    def misregistered(
        self,
        stop_m: tuple[float, float],
        rotation_deg: float,
        obscuration_m: float = OBSCURATION_M,
        vane_width_m: float = VANE_WIDTH_M,
    ) -> np.ndarray:
        """Transmission where an annular stop at `stop_m` and the pupil with turned vanes are both clear."""
        annulus = hcipy.make_obstructed_circular_aperture(DIAMETER_M, obscuration_m / DIAMETER_M)
        stop, spiders = hcipy.make_shifted_aperture(annulus, stop_m), []
        for side in (1, -1):
            origin = (side * VANE_ORIGIN_M, side * VANE_ORIGIN_M)
            for tip in ((side * VANE_TIP_M, 0.0), (0.0, side * VANE_TIP_M)):
                spiders.append(hcipy.make_spider(origin, tip, vane_width_m))
        turned = [hcipy.make_rotated_aperture(one, np.deg2rad(rotation_deg)) for one in (annulus, *spiders)]
        return _supersampled(
            self.grid, self.step_m, lambda grid: stop(grid) * np.prod([one(grid) for one in turned], axis=0)
        )

    def image(
        self, zernike_nm, wavelength_nm: float, window, pixel_scale_mas: float, transmission=None
    ) -> np.ndarray:
        """Pixel-integrated image (rows, columns); `zernike_nm` is a dict, or a flat OPD [nm].

        Another `transmission` than that of the pupil still counts as fractions of the light through it.
        """
        opd = self.opd_nm(zernike_nm) if isinstance(zernike_nm, dict) else zernike_nm
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        pixel = pixel_scale_mas * MAS_RAD
        rows, columns = ((np.arange(n) - (n - 1) / 2)[:, None] + nodes / 2 for n in window)
        wavenumber = 2 * np.pi / (wavelength_nm * 1e-9)
        axes = [columns.ravel() * pixel * wavenumber, rows.ravel() * pixel * wavenumber]
        focal = hcipy.CartesianGrid(hcipy.SeparatedCoords(axes))
        transform = hcipy.MatrixFourierTransform(self.grid, focal)
        amplitude = self.transmission if transmission is None else transmission
        field = hcipy.Field(amplitude * np.exp(2j * np.pi * opd / wavelength_nm), self.grid)
        intensity = np.abs(np.asarray(transform.forward(field))) ** 2
        fine = intensity.reshape(window[0], NODES, window[1], NODES)
        integrated = np.einsum("yjxi,j,i->yx", fine, weights / 2, weights / 2)
        # Parseval: the integral over all angles is wavelength^2 times the clear area
        return integrated * pixel**2 / (self.area_m2 * (wavelength_nm * 1e-9) ** 2)

    def spectral_image(self, zernike_nm, settings) -> np.ndarray:
        """Image in the spectrum, window and scale of a `PsfSettings`, with its known wavefront added."""
        known_nm = settings.known.total_nm
        total = {
            noll: zernike_nm.get(noll, 0.0) + known_nm.get(noll, 0.0) for noll in {*zernike_nm, *known_nm}
        }
        weight = sum(w for _, w in settings.spectrum)
        return sum(
            w / weight * self.image(total, nm, settings.window, settings.pixel_scale_mas)
            for nm, w in settings.spectrum
        )


def _supersampled(grid, step_m: float, aperture=ut4_aperture) -> np.ndarray:
    """Area-weighted transmission: mean over points spread evenly in every cell."""
    offsets = ((np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5) * step_m
    shifted = (aperture(grid.shifted([dx, dy])) for dx in offsets for dy in offsets)
    return np.asarray(sum(shifted)) / SUBSAMPLES**2


@functools.cache
def reference(samples: int = 1024) -> ReferenceImager:
    """The imager, built once per test process."""
    return ReferenceImager(samples)
