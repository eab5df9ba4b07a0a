"""Cubes of noise-limited frames made by HCIPy, with something hidden in them, and their diagnosis."""

import functools
from collections.abc import Callable

import numpy as np

from helpers.optics_cases import (
    BAND,
    DIVERSITY,
    NCPA_LAW,
    READ_NOISE,
    RESIDUAL_LAW,
    draw_frames,
    everything,
    ncpa_nm,
    settings,
    shift_nm,
)
from helpers.reference_psf import ReferenceImager, reference
from irlos_pipe.diagnosis.records import Options
from irlos_pipe.diagnosis.verdict import Diagnosis
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Conditions
from irlos_pipe.estimate.cube import Frames

WINDOW, HIGHEST_NOLL, FRAMES, FLUX_E, WAVELENGTH_NM = 40, 15, 32, 1e6, 1600.0
TRUE_NM = ncpa_nm(5, HIGHEST_NOLL, 100.0)
CASE = settings(WINDOW, pupil_samples=64)
CONDITIONS = Conditions(CASE, BAND, RESIDUAL_LAW, 0.5, HIGHEST_NOLL, ncpa_law=NCPA_LAW)
COMPANION = {"flux_ratio": 0.03, "x_px": -9.3, "y_px": 6.1}
FURTHER = {"flux_ratio": 0.01, "x_px": 7.8, "y_px": 10.4}
PUPIL = {"rotation_deg": 2.0, "obscuration_m": 1.22, "vane_width_m": 0.05}
SPOT_M, SPOT_RADIUS_M = (1.6, -1.9), 0.45
GHOST = COMPANION | {"defocus_nm": 80.0}


def options(most_names: int = 4) -> Options:
    """As the stage has them, for the modes of these cubes."""
    return Options(HIGHEST_NOLL, held_out=0.25, most_names=most_names, sure=5.0)


def opd_nm(imager: ReferenceImager, **moved: float) -> np.ndarray:
    """NCPAs and diversity, displaced by some pixels along x and y, and with further defocus [nm RMS]."""
    total = {noll: TRUE_NM.get(noll, 0.0) + DIVERSITY.get(noll, 0.0) for noll in {*TRUE_NM, *DIVERSITY}}
    total[2] += shift_nm(moved.get("x_px", 0.0))
    total[3] += shift_nm(moved.get("y_px", 0.0))
    total[4] += moved.get("defocus_nm", 0.0)
    return imager.opd_nm(total)


def plain() -> np.ndarray:
    """The star and nothing else, unit flux."""
    imager = reference()
    return imager.image(opd_nm(imager), WAVELENGTH_NM, CASE.window, 9.7)


def with_second_images(*seconds: dict[str, float]) -> np.ndarray:
    """Images of the star next to it, each of its share, place and focus: the sum of all images."""
    imager, total = reference(), 1 + sum(one["flux_ratio"] for one in seconds)
    images = (imager.image(opd_nm(imager, **one), WAVELENGTH_NM, CASE.window, 9.7) for one in seconds)
    lights = (one["flux_ratio"] * image for one, image in zip(seconds, images, strict=True))
    return (plain() + sum(lights)) / total


def with_companion() -> np.ndarray:
    return with_second_images(COMPANION)


def with_spot() -> np.ndarray:
    """An opaque disc in the pupil."""
    x, y = SPOT_M
    return with_opaque(lambda grid: np.hypot(grid.x - x, grid.y - y) < SPOT_RADIUS_M)


def with_scratch(width_m: float = 0.12) -> np.ndarray:
    """An opaque line across the pupil, off its centre, which the catalogue does not have."""
    return with_opaque(lambda grid: np.abs(0.8 * grid.x - 0.6 * grid.y - 1.7) < width_m / 2)


def with_opaque(dark: Callable) -> np.ndarray:
    """A part of the pupil is `dark`."""
    imager = reference()
    clear = ~np.asarray(dark(imager.grid))
    return imager.image(
        opd_nm(imager), WAVELENGTH_NM, CASE.window, 9.7, transmission=imager.transmission * clear
    )


def with_another_pupil() -> np.ndarray:
    """A pupil of another hole, with other vanes, turned."""
    imager = reference()
    pupil = imager.misregistered(
        (0.0, 0.0), PUPIL["rotation_deg"], PUPIL["obscuration_m"], PUPIL["vane_width_m"]
    )
    return imager.image(opd_nm(imager), WAVELENGTH_NM, CASE.window, 9.7, transmission=pupil)


def cube(image: np.ndarray, seed: int = 3) -> Frames:
    images = draw_frames(image * FLUX_E, FRAMES, seed=seed)
    return Frames(images, everything(images), READ_NOISE)


@functools.cache
def diagnosis_of(kind: str) -> Diagnosis:
    """Diagnosis of one of the images above, made once per test process."""
    images = {
        "plain": plain,
        "companion": with_companion,
        "two": functools.partial(with_second_images, COMPANION, FURTHER),
        "ghost": functools.partial(with_second_images, GHOST),
        "pupil": with_another_pupil,
        "spot": with_spot,
        "scratch": with_scratch,
    }
    return diagnose([Exposures(cube(images[kind]()), CONDITIONS)], [], options())
