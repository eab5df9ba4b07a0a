"""Error of Noll 2–30 against the number of estimated modes (paper, appendix B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.calibration import Calibration, CalibrationOptions, calibrate
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.mode_number import choose, fit_mode_numbers, scan_mode_numbers
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.paper.common.observation import frames_of, model_effects_of, modes_delta_nm, settings_of
from irlos_pipe.paper.common.variants import with_prior
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Scene

DEFAULT = "long_exposure"


@dataclass(frozen=True)
class NumberSample:
    """One cube and the fits made to it.

    Attributes
    ----------
    cube : Sample
        Its `variants` and `mag_j` are not used.
    highest_nolls : tuple of int
        Modes Noll 2 to each of these are estimated.
    magnitudes : mapping of str to tuple of float
        J magnitudes for every method.
    frames : mapping of str to int
        Frames that a method is given.
    """

    name: str
    cube: Sample
    highest_nolls: tuple[int, ...]
    magnitudes: Mapping[str, tuple[float, ...]]
    frames: Mapping[str, int]


def errors_by_number(sample: NumberSample) -> dict[str, np.ndarray]:
    """Simulate a cube, dim it, and estimate few and many modes.

    Returns
    -------
    dict of str to ndarray
        ``<method>/error_nm``, (magnitudes, numbers): Δ-WFE in Noll 2–30; ``recommended_noll``, what
        held-out frames recommend to the default at its first magnitude, and ``held_out``, (numbers,),
        the misfit they show.
    """
    scene = scene_of(sample.cube)
    exposed = expose(scene)
    numbers = {
        f"{method}/error_nm": np.array([_errors(sample, scene, exposed, method, mag) for mag in mags])
        for method, mags in sample.magnitudes.items()
    }
    cube, bright = _cube(scene, exposed, sample.magnitudes[DEFAULT][0])
    scan = scan_mode_numbers(
        cube,
        settings_of(bright),
        _options(DEFAULT, scene.facility.ncpa_law),
        sample.highest_nolls,
        model_effects_of(bright),
    )
    choice = choose(scan.misfit)
    return numbers | {
        "recommended_noll": np.array(scan.highest_nolls[choice.recommended]),
        "held_out": scan.misfit.mean(axis=1),
    }


def _errors(
    sample: NumberSample, scene: Scene, exposed: Exposed, method: str, mag_j: float
) -> Sequence[float]:
    """Δ-WFE of one method at one magnitude for every number of modes."""
    cube, dimmed = _cube(scene, exposed, mag_j)
    count = sample.frames[method]
    own = replace(cube, images_e=cube.images_e[:count])
    fit = fit_mode_numbers if method == DEFAULT else _from_none
    options = _options(method, scene.facility.ncpa_law)
    fits = fit(own, settings_of(dimmed), options, sample.highest_nolls, model_effects_of(dimmed))
    return [modes_delta_nm(exposed, one.nolls, one.zernike_nm, first_frames=count) for one in fits]


def _from_none(
    frames: Frames, settings: PsfSettings, options: CalibrationOptions, highest_nolls: Sequence[int], effects
) -> list[Calibration]:
    """Every number of modes by itself, as the published methods are meant."""
    return [
        calibrate(frames, settings, replace(options, highest_noll=highest), effects)
        for highest in highest_nolls
    ]


def _options(method: str, ncpa_law: NcpaLaw) -> CalibrationOptions:
    """The default has its prior; the others have none, as published."""
    options = CalibrationOptions(method)
    return with_prior(options, ncpa_law) if method == DEFAULT else options


def _cube(scene: Scene, exposed: Exposed, mag_j: float) -> tuple[Frames, Scene]:
    """The same star as if it were of another magnitude, with noise of its own."""
    dimmed = replace(scene, mag_j=mag_j)
    factor = np.float32(dimmed.photons / scene.photons)
    return frames_of(dimmed, replace(exposed, mean_e=exposed.mean_e * factor)), dimmed
