"""The pupil that light goes through: drawn finely, disturbed, and sampled without aliasing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.signal import firwin

from irlos_pipe.conventions.pupil import PupilGeometry
from irlos_pipe.simulate.aperture import centres, clear_fraction, with_vanes_turned
from irlos_pipe.simulate.petals import petal_opd_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope

FINE = 4  # drawn cells per sample and axis
PAD = 4  # samples beyond the diameter on each side, where the low-pass rings
TAPS = 2 * PAD * FINE
KAISER_BETA = 5.0  # stop band at -53 dB


@dataclass(frozen=True, eq=False)
class Pupil(Telescope):
    """Pupil on a grid that reaches `PAD` samples beyond the diameter.

    Attributes
    ----------
    geometry : PupilGeometry
        As built: with the spider where it is.
    drawn : ndarray, (FINE n, FINE n)
        Clear fraction of the cells of the drawing.
    """

    drawn: np.ndarray

    @cached_property
    def telescope(self) -> Telescope:
        """The same pupil on the samples across the diameter alone."""
        return Telescope(self.geometry, self.u_m[PAD:-PAD], self.inside(self.transmission))

    def inside(self, opd_nm: np.ndarray) -> np.ndarray:
        """Cut (..., n, n) to the samples across the diameter."""
        return opd_nm[..., PAD:-PAD, PAD:-PAD]

    def drawing_grid_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates x (1, FINE n) and y (FINE n, 1) of the drawing's cells [m]."""
        fine = centres(len(self.u_m) * FINE, self.step_m / FINE)
        return fine[None, :], fine[:, None]

    def sampled(self, drawn_amplitude: np.ndarray) -> np.ndarray:
        """Amplitude at the samples, (n, n), without the frequencies that they cannot hold.

        Edges, vanes and steps are narrower than a sample. Averaged over cells they would blur the
        image by a sample's width; low-passed with a flat pass band they leave alone what a window of
        a few tens of λ/D sees.

        Parameters
        ----------
        drawn_amplitude : ndarray, (FINE n, FINE n), real or complex
        """
        low_pass = _low_pass(len(self.u_m))
        return low_pass @ drawn_amplitude @ low_pass.T


def pupil_of(scene: Scene) -> Pupil:
    """Pupil at the scene's sampling, with the effect `pupil_misregistration`.

    `dx_m`, `dy_m` displace an internal stop; `rotation_deg` turns the vanes anticlockwise.
    """
    effect = scene.effects.get("pupil_misregistration", {})
    stop_m = (effect.get("dx_m", 0.0), effect.get("dy_m", 0.0))
    turn_deg = effect.get("rotation_deg", 0.0)
    return _build(scene.geometry, scene.pupil_samples, stop_m if any(stop_m) else None, turn_deg)


def nominal_area_m2(scene: Scene) -> float:
    """Clear area of the undisturbed pupil, which the photometry refers to [m²]."""
    return _build(scene.geometry, scene.pupil_samples, None, 0.0).area_m2


@lru_cache(maxsize=8)
def _build(
    geometry: PupilGeometry, samples: int, stop_m: tuple[float, float] | None, turn_deg: float
) -> Pupil:
    as_built = with_vanes_turned(geometry, turn_deg) if turn_deg else geometry
    step_m, total = geometry.diameter_m / samples, samples + 2 * PAD
    drawn = clear_fraction(as_built, centres(total * FINE, step_m / FINE), stop_m)
    transmission = drawn.reshape(total, FINE, total, FINE).mean(axis=(1, 3))
    return Pupil(as_built, centres(total, step_m), transmission, drawn)


def amplitude(scene: Scene, pupil: Pupil, wavelength_nm: float) -> np.ndarray:
    """Pupil amplitude (n, n) at a wavelength; complex with the effect `low_wind_effect`.

    The steps between petals lie on the vanes, so they belong to the drawing rather than to the smooth
    wavefront that multiplies the samples.
    """
    transparent = transparency(scene, pupil)
    if "low_wind_effect" not in scene.effects:
        return transparent * pupil.sampled(pupil.drawn)
    steps_nm = petals_nm(scene, pupil, *pupil.drawing_grid_m())
    return transparent * pupil.sampled(pupil.drawn * np.exp(2j * np.pi / wavelength_nm * steps_nm))


def petals_nm(scene: Scene, pupil: Pupil, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Wavefront of the effect `low_wind_effect` at points [nm]; zero without it."""
    effect = scene.effects.get("low_wind_effect")
    if effect is None:
        return np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape))
    return petal_opd_nm(effect, pupil.geometry, x_m, y_m)


def transparency(scene: Scene, pupil: Telescope) -> np.ndarray:
    """Relative amplitude of the effect `amplitude_aberration`, (n, n): one plus a sum of Zernikes."""
    zernike = scene.effects.get("amplitude_aberration", {}).get("zernike", {})
    return np.maximum(1 + pupil.opd_nm(zernike), 0.0)


@lru_cache(maxsize=8)
def _low_pass(samples: int) -> np.ndarray:
    """Matrix from the drawing to the samples, (samples, FINE samples); rows sum to 1.

    Flat to half the samples' Nyquist frequency, zero from one and a half: what folds back lands
    beyond the flat part.
    """
    taps = firwin(TAPS, 1 / FINE, window=("kaiser", KAISER_BETA))
    matrix = np.zeros((samples, FINE * samples))
    for index in range(samples):
        first = index * FINE + FINE // 2 - TAPS // 2
        low, high = max(first, 0), min(first + TAPS, FINE * samples)
        matrix[index, low:high] = taps[low - first : high - first]
    return matrix
