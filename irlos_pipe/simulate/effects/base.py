"""Bases of the simulated effects: one per plane of the light path, with what an effect may change there.

An effect is a frozen dataclass whose fields are its parameters. Names, units and limits of the parameters
that models and reports know stand in `irlos_pipe.effects`; the simulator's own ones are declared by `own`.
A new effect is one file here and one line in `irlos_pipe.simulate.effects.catalogue`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from typing import Any, ClassVar

import numpy as np

from irlos_pipe.conventions.facility import Facility, VibrationLine
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.charge import Pixels
from irlos_pipe.simulate.light import Band, Ray
from irlos_pipe.simulate.motion_blur import MotionBlur
from irlos_pipe.simulate.telescope import Telescope

INFINITE = float("inf")


@dataclass(frozen=True)
class Own:
    """A parameter that only the simulator has: its unit, and the limits of every number in it."""

    unit: str
    lower: float = -INFINITE
    upper: float = INFINITE


def own(unit: str, lower: float = -INFINITE, upper: float = INFINITE, default: Any = None) -> Any:
    """Declare a field that only the simulator has: `unit`, limits `lower` and `upper`, and its `default`."""
    return field(default=default, metadata={"own": Own(unit, lower, upper)})


def wider(lower: float, upper: float, default: Any = MISSING) -> Any:
    """Declare a field of which more can be simulated than models accept.

    Parameters
    ----------
    lower, upper : float
        Limits of every number in it.
    default : optional
        Without one the field is required.
    """
    return field(default=default, metadata={"wider": (lower, upper)})


@dataclass(frozen=True)
class RecordingSetup:
    """Pupil, number of bands, window (rows, columns), diversity [nm RMS by Noll], which effects must fit."""

    geometry: PupilGeometry
    bands: int
    window: tuple[int, int]
    diversity_nm: Mapping[int, float]


@dataclass(frozen=True)
class SimulatedEffect:
    """An effect by its name in recipes, models, truth files and reports."""

    name: ClassVar[str]

    def misfit(self, setup: RecordingSetup) -> str:
        """Return why the effect cannot be in a recording of this `setup`; empty if it can."""
        return ""


class LightEffect(SimulatedEffect):
    """Acts on the light that arrives: wavelengths, sources, directions."""

    def spectrum(
        self, wavelengths_nm: np.ndarray, weights: np.ndarray, bands: Sequence[Band]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return wavelengths [nm] and photon weights, (points,) each; only ratios of weights count.

        Parameters
        ----------
        wavelengths_nm, weights : ndarray, (points,)
        bands : sequence of Band
            Each has as many of the points, one band after the other.
        """
        return wavelengths_nm, weights

    def rays(self, rays: list[Ray]) -> list[Ray]:
        """Return the `rays` with the effect."""
        return rays

    def pixel_scale_mas(self, assumed_mas: float) -> float:
        """Return the true pixel scale [mas]."""
        return assumed_mas

    def stretch(self) -> np.ndarray:
        """Return the matrix by which the image is stretched about the optical axis, in (x, y), (2, 2)."""
        return np.eye(2)


class SkyEffect(SimulatedEffect):
    """Changes the AO residual."""

    def sky(self, sky: Sky | None, facility: Facility) -> Sky | None:
        """Return the `sky` of a scene at a `facility` with the effect; None is the bench."""
        raise NotImplementedError


class PupilEffect(SimulatedEffect):
    """Changes where light passes the pupil, or puts steps into the wavefront there."""

    @property
    def stop_m(self) -> tuple[float, float] | None:
        """Position (x, y) of an internal stop [m]."""
        return None

    def built(self, geometry: PupilGeometry) -> PupilGeometry:
        """Return the pupil as it is built, of which the side-car tells the `geometry`."""
        return geometry

    def transparency(self, pupil: Telescope) -> np.ndarray | float:
        """Return the relative amplitude on the samples of the `pupil`, (n, n)."""
        return 1.0

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray | None:
        """Return the wavefront with steps at points of the pupil [nm].

        Parameters
        ----------
        geometry : PupilGeometry
        x_m, y_m : ndarray, shapes that broadcast

        Returns
        -------
        ndarray or None
            None for an effect that makes no steps.
        """
        return None


class WavefrontEffect(SimulatedEffect):
    """Adds a smooth wavefront that does not change during a frame."""

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        """Return static coefficients, Noll: nm RMS, beside the declared diversity `diversity_nm`."""
        return {}

    def chromatic_zernike_nm(self, wavelength_nm: float, mean_nm: float) -> Mapping[int, float]:
        """Return coefficients at one wavelength only, Noll: nm RMS.

        Parameters
        ----------
        wavelength_nm, mean_nm : float
            The wavelength, and the photon-weighted mean of the bands' centres.
        """
        return {}

    def static_opd_nm(self, telescope: Telescope) -> np.ndarray | float:
        """Return a static wavefront (n, n) [nm] that is no sum of Zernikes, on the grid of `telescope`."""
        return 0.0

    def drift_zernike_nm(self) -> Mapping[int, float]:
        """Return the change from the first frame to the last, Noll: nm RMS."""
        return {}


class LensEffect(SimulatedEffect):
    """Changes the wavefront that a moved focus makes."""

    def defocus(self, telescope: Telescope) -> np.ndarray:
        """Return the wavefront (n, n) of introduced defocus on `telescope`, its part of Noll 4 being one."""
        return telescope.mode(DEFOCUS)


class FocusStageEffect(SimulatedEffect):
    """Makes the focus stage miss its commanded position."""

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Return the defocus that the stage introduces, (positions,) [nm RMS].

        Parameters
        ----------
        reached_nm, commanded_nm : ndarray, (positions,)
            Without the effect, and as commanded, in the order of time [nm RMS].
        rng : numpy.random.Generator
        """
        raise NotImplementedError


class MotionEffect(SimulatedEffect):
    """Moves the image within a frame."""

    sigma_mas: float  # RMS of the motion

    def blur(self, exposure_s: float, lines: Sequence[VibrationLine], rng: np.random.Generator) -> MotionBlur:
        """Return the motion within the next frame.

        Parameters
        ----------
        exposure_s : float
        lines : sequence of (frequency_hz, share_x, share_y)
            Vibrations of the telescope.
        rng : numpy.random.Generator
        """
        raise NotImplementedError


class DetectorEffect(SimulatedEffect):
    """Changes the pixels."""

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        """Return the `pixels` with the effect; `mean_image_e` (rows, columns) is that of one read [e-]."""
        raise NotImplementedError
