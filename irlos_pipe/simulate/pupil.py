"""The pupil that light goes through: drawn finely, disturbed, and sampled without aliasing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce

import numpy as np
from scipy.signal import firwin

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate.aperture import centres, clear_fraction
from irlos_pipe.simulate.effects.pupil import PupilEffect
from irlos_pipe.simulate.effects.wavefront import WavefrontEffect
from irlos_pipe.simulate.light import mean_centre_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope, sum_nm

FINE = 4  # drawn cells per sample and axis
PAD = 4  # samples beyond the diameter on each side, where the low-pass rings
TAPS = 2 * PAD * FINE
KAISER_BETA = 5.0  # of the low-pass window: its stop band is at -53 dB


@dataclass(frozen=True, eq=False)
class Pupil(Telescope):
    """Pupil on a grid that reaches `PAD` samples beyond the diameter; `geometry` is as built.

    `drawn`, (FINE n, FINE n), is the mean amplitude in the cells of the drawing.
    """

    drawn: np.ndarray

    @property
    def area_m2(self) -> float:
        """Return the clear area; where the pupil is a map, ∫ P² [m²]."""
        if self.geometry.map is None:
            return super().area_m2
        before = replace(self.geometry, obscuration_m=0.0, vanes=(), obstructions=())
        alone = clear_fraction(before, self.drawing_grid_m()[0][0])
        return self.geometry.map.light_m2 * float((self.drawn**2).sum() / (alone**2).sum())

    @cached_property
    def telescope(self) -> Telescope:
        """Return the pupil on the samples across the diameter alone."""
        return Telescope(self.geometry, self.u_m[PAD:-PAD], self.inside(self.transmission))

    def inside(self, opd_nm: np.ndarray) -> np.ndarray:
        """Cut `opd_nm` (..., n, n) to the samples across the diameter."""
        return opd_nm[..., PAD:-PAD, PAD:-PAD]

    def drawing_grid_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates x (1, FINE n) and y (FINE n, 1) of the drawing's cells [m]."""
        fine = centres(len(self.u_m) * FINE, self.step_m / FINE)
        return fine[None, :], fine[:, None]

    def sampled(self, drawn_amplitude: np.ndarray) -> np.ndarray:
        """Return the amplitude at the samples, (n, n), of `drawn_amplitude`, (FINE n, FINE n).

        Edges, vanes and steps are narrower than a sample. Averaged over cells they would blur the image by a
        sample's width; low-passed with a flat pass band, without the frequencies that the samples cannot
        hold, they leave alone what a window of a few tens of λ/D sees.
        """
        low_pass = _low_pass(len(self.u_m))
        return low_pass @ drawn_amplitude @ low_pass.T


def pupil_of(scene: Scene) -> Pupil:
    """Return the pupil at the sampling of a `scene`, with its effects."""
    effects = scene.acting(PupilEffect)
    stops_m = [effect.stop_m for effect in effects if effect.stop_m is not None]
    as_built = reduce(lambda geometry, effect: effect.built(geometry), effects, scene.geometry)
    return _build(as_built, scene.pupil_samples, stops_m[0] if stops_m else None)


def nominal_area_m2(scene: Scene) -> float:
    """Return the clear area of the undisturbed pupil, which the photometry refers to [m²]."""
    return _build(scene.geometry, scene.pupil_samples, None).area_m2


@lru_cache(maxsize=8)
def _build(as_built: PupilGeometry, samples: int, stop_m: tuple[float, float] | None) -> Pupil:
    step_m, total = as_built.diameter_m / samples, samples + 2 * PAD
    drawn = clear_fraction(as_built, centres(total * FINE, step_m / FINE), stop_m)
    transmission = drawn.reshape(total, FINE, total, FINE).mean(axis=(1, 3))
    return Pupil(as_built, centres(total, step_m), transmission, drawn)


def amplitude(scene: Scene, pupil: Pupil, wavelength_nm: float, defocus_nm: float = 0.0) -> np.ndarray:
    """Return the amplitude (n, n) in the `pupil` of a `scene`, complex where this light has an own wavefront.

    Such are what depends on `wavelength_nm`, the focus of a ray (`defocus_nm`, Noll 4 beyond that of the
    wavefront, nm RMS), and steps between petals. These lie on the vanes, so they belong to the drawing rather
    than to the smooth wavefront that multiplies the samples.
    """
    transparency: np.ndarray | float = 1.0
    mean_nm, effects = mean_centre_nm(scene.bands), scene.acting(WavefrontEffect)
    chromatic = (effect.chromatic_zernike_nm(wavelength_nm, mean_nm) for effect in effects)
    own_nm = sum_nm([{DEFOCUS: defocus_nm} if defocus_nm else {}, *chromatic])
    if own_nm:
        transparency = np.exp(2j * np.pi / wavelength_nm * pupil.opd_nm(own_nm))
    for effect in scene.acting(PupilEffect):
        transparency = transparency * effect.transparency(pupil)
    steps = steps_nm(scene, pupil, *pupil.drawing_grid_m())
    if steps is None:
        return transparency * pupil.sampled(pupil.drawn)
    return transparency * pupil.sampled(pupil.drawn * np.exp(2j * np.pi / wavelength_nm * steps))


def steps_nm(scene: Scene, pupil: Pupil, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray | None:
    """Return the wavefront with steps [nm] that effects of the `scene` make; None without such effects.

    It is that at points (`x_m`, `y_m`) of its `pupil`, shapes that broadcast.
    """
    made = (effect.steps_nm(pupil.geometry, x_m, y_m) for effect in scene.acting(PupilEffect))
    given = [steps for steps in made if steps is not None]
    return sum(given[1:], start=given[0]) if given else None


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
