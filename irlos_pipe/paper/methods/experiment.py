"""Methods compared on simulated cubes (paper, Fig. "methods"), and what each part of the default buys.

One sample is one cube with its own NCPAs and its own AO residual. Beside the seeing, the residual's
power spectrum can have another shape than the model of the default assumes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.paper.common.observation import (
    delta_wfe,
    frames_of,
    introduced_wfe_nm,
    model_effects_of,
    modes_delta_nm,
    settings_of,
)
from irlos_pipe.paper.common.variants import DEFAULT, VARIANTS
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Band, Sampling, Scene

NARROW_H = (Band(1600.0, 20.0),)
NARROW_THROUGHPUT = 0.14  # width of the narrow band over that of J+H, for which the zero point holds
DIVERSITY_NM = {6: -170.0}
NCPA_NM, NCPA_SCATTER_NM = 142.0, 30.0
LOW_GAIN = DetectorModel(e_per_adu=3.0)  # a star of m_J 7 must not saturate the converter in 0.1 s


@dataclass(frozen=True)
class Sample:
    """One cube, and the ways it is calibrated.

    Attributes
    ----------
    shape : str
        Shape of the AO residual's power spectrum, see `Sky`.
    variants : tuple of str
        Keys of `VARIANTS`.
    fractions : tuple of float
        Parts of the cube to which the default is applied as well.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    seeing_arcsec: float
    shape: str
    frames: int
    variants: tuple[str, ...]
    fractions: tuple[float, ...] = ()
    mag_j: float = 7.0
    jitter_mas: float = 7.0


def scene_of(sample: Sample) -> Scene:
    """The recording of a sample: narrow H band, 0.1 s at 10 Hz, NCPAs of 142 ± 30 nm over 50 modes."""
    rng = np.random.default_rng(sample.seed)
    total_nm = max(rng.normal(NCPA_NM, NCPA_SCATTER_NM), NCPA_SCATTER_NM)
    return Scene(
        sample.name,
        sample.facility,
        NARROW_H,
        sample.seed,
        sample.frames,
        0.1,
        mag_j=sample.mag_j,
        throughput=NARROW_THROUGHPUT,
        ncpa_nm=draw_ncpa_nm(rng, sample.facility.ncpa_law, total_nm),
        diversity_nm=DIVERSITY_NM,
        sky=Sky(seeing_arcsec=sample.seeing_arcsec, shape=sample.shape),
        motion=Motion(rms_mas=sample.jitter_mas),
        detector=LOW_GAIN,
        sampling=Sampling(points_per_band=3),
    )


def compare(sample: Sample) -> dict[str, float]:
    """Simulate a cube and calibrate it in every way.

    Returns
    -------
    dict of str to float
        ``<variant>/modes_nm`` and ``<variant>/pupil_nm`` (Δ-WFE in Noll 2–30 and over the full pupil),
        ``<variant>/chi2_nu``, ``fraction_<part>/modes_nm``, and ``introduced_nm``.
    """
    scene = scene_of(sample)
    exposed = expose(scene)
    frames = frames_of(scene, exposed)
    numbers = {"introduced_nm": introduced_wfe_nm(exposed)}
    for name in sample.variants:
        numbers |= _numbers(name, scene, exposed, frames)
    for part in sample.fractions:
        numbers[f"fraction_{part:g}/modes_nm"] = _error_of_part(scene, exposed, frames, part)
    return numbers


def _numbers(name: str, scene: Scene, exposed: Exposed, frames: Frames) -> dict[str, float]:
    result = VARIANTS[name].calibrate(
        frames, settings_of(scene), model_effects_of(scene), scene.facility.ncpa_law
    )
    wrong = delta_wfe(exposed, result.nolls, result.zernike_nm)
    return {
        f"{name}/modes_nm": wrong.modes_nm,
        f"{name}/pupil_nm": wrong.pupil_nm,
        f"{name}/chi2_nu": result.chi2_nu,
    }


def _error_of_part(scene: Scene, exposed: Exposed, frames: Frames, part: float) -> float:
    """Δ-WFE of the default in Noll 2–30 from the first frames of a cube, against their own mean wavefront."""
    count = max(2, round(part * len(frames.images_e)))
    fewer = replace(frames, images_e=frames.images_e[:count])
    result = VARIANTS[DEFAULT].calibrate(
        fewer, settings_of(scene), model_effects_of(scene), scene.facility.ncpa_law
    )
    return modes_delta_nm(exposed, result.nolls, result.zernike_nm, first_frames=count)


@dataclass(frozen=True)
class Distribution:
    """Δ-WFE of one variant over the samples of one condition [nm].

    Attributes
    ----------
    median_nm, p16_nm, p84_nm, worst_nm : float
    samples : int
    """

    median_nm: float
    p16_nm: float
    p84_nm: float
    worst_nm: float
    samples: int

    @classmethod
    def of(cls, values_nm: Sequence[float]) -> Distribution:
        """Percentiles of a list of values."""
        p16, median, p84 = np.percentile(values_nm, [15.87, 50, 84.13])
        return cls(float(median), float(p16), float(p84), float(np.max(values_nm)), len(values_nm))


def speckle_floor_nm(errors_nm: Mapping[float, Sequence[float]]) -> tuple[float, float]:
    """Split the default's error into what more frames would remove and what they would not.

    ``error² = floor² / part + rest²``, least squares over the mean squares at every part of the cube.

    Parameters
    ----------
    errors_nm : mapping
        Errors over samples by the part of the cube that was used, 1 for all of it.

    Returns
    -------
    floor_nm, rest_nm : float
        Error from the finite number of speckles in the whole cube; error of an endless cube.
    """
    parts = np.array(sorted(errors_nm))
    squares = np.array([np.mean(np.square(errors_nm[part])) for part in parts])
    # Relative errors of the mean squares are alike, so every equation is divided by its own square.
    design = np.stack([1 / parts, np.ones(len(parts))], axis=1) / squares[:, None]
    noise, rest = np.maximum(np.linalg.lstsq(design, np.ones(len(parts)), rcond=None)[0], 0)
    return float(np.sqrt(noise)), float(np.sqrt(rest))
