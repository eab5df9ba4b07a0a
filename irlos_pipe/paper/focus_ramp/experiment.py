"""A focus ramp with and without calibrated NCPAs (paper, Fig. "Calibrated LIFT").

The NCPAs of a sample are calibrated from a cube of the narrow H band; the ramp of the same star in J+H
has the same NCPAs and other residuals. Every way of estimating it sees the same frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.estimate.ramp import summarise
from irlos_pipe.paper.common.broad_band import star_scene
from irlos_pipe.paper.common.ramps import (
    DEFOCUS,
    NINE,
    TTF,
    ObservedRamp,
    Way,
    calibrated,
    observe,
)
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Sampling, Scene

PUBLISHED = "dip_global"
KERNEL_MAS = 12.0  # σ_obj of the paper's first target
# A frame of a second averages fifty moments of a residual that renews itself every 10 ms.
SAMPLING = Sampling(points_per_band=3, step_s=0.02)
RAMP_STREAM = 1  # residuals of the ramp are not those of the cube
MODES = {3: TTF, 9: NINE}


def _ways(key: str, label: str, **choices) -> dict[str, Way]:
    return {f"{key}_{count}": Way(label, modes, **choices) for count, modes in MODES.items()}


# The kernel is fixed by hand as in the paper, or fitted to the ramp; the default takes what it calibrated.
WAYS = (
    _ways("none", "no NCPAs, kernel 12 mas", halo="off", kernel=KERNEL_MAS)
    | _ways("none_residual", "no NCPAs, AO residual expected")
    | _ways("published", "NCPAs by DIP global, kernel 12 mas", ncpa=PUBLISHED, halo="off", kernel=KERNEL_MAS)
    | _ways("published_fit", "NCPAs by DIP global, kernel fitted", ncpa=PUBLISHED, halo="off", kernel="fit")
    | _ways("default", "default: NCPAs, AO residual, jitter as calibrated", ncpa=DEFAULT)
)


@dataclass(frozen=True)
class RampSample:
    """One set of NCPAs: a cube to calibrate them, and a ramp.

    Attributes
    ----------
    offsets_nm : tuple of float
        Introduced defocus.
    ways : tuple of str
        Keys of `WAYS`.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    offsets_nm: tuple[float, ...]
    frames_per_offset: int
    cube_frames: int
    ways: tuple[str, ...] = tuple(WAYS)
    seeing_arcsec: float = 0.35
    cube_mag_j: float = 7.0
    ramp_mag_j: float = 12.0


def scenes_of(sample: RampSample) -> tuple[Scene, Scene]:
    """Calibration cube and ramp of a sample."""
    conditions = Sample(
        sample.name,
        sample.seed,
        sample.facility,
        sample.seeing_arcsec,
        "power_law",
        sample.cube_frames,
        (),
        mag_j=sample.cube_mag_j,
    )
    cube = replace(scene_of(conditions), sampling=SAMPLING)
    introduced_nm = tuple(np.repeat(sample.offsets_nm, sample.frames_per_offset).tolist())
    ramp = star_scene(
        sample.name,
        sample.facility,
        (*sample.seed, RAMP_STREAM),
        len(introduced_nm),
        sample.ramp_mag_j,
        cube.ncpa_nm,
        introduced_nm,
        seeing_arcsec=sample.seeing_arcsec,
    )
    return cube, replace(ramp, sampling=SAMPLING)


def estimate(sample: RampSample) -> dict[str, np.ndarray]:
    """Simulate cube and ramp of a sample and estimate the ramp in every way.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm`` (frames,); ``true_nm`` (frames, 10), Noll 2–11 of the frame's own mean wavefront,
        introduced defocus included, diversity not; and for every way ``<way>/modes_nm`` (frames, modes) the
        same modes as estimated, the NCPAs given to it included, ``<way>/defocus_nm`` (frames,) its
        estimate without them, and ``<way>/converged``.
    """
    cube, ramp = scenes_of(sample)
    methods = dict.fromkeys(WAYS[key].ncpa for key in sample.ways if WAYS[key].ncpa)
    exposed = expose(ramp)
    observed = observe(ramp, exposed, calibrated(cube, list(methods)))
    found = {"introduced_nm": ramp.introduced_per_frame_nm, "true_nm": true_modes_nm(ramp, exposed)}
    for key in sample.ways:
        found |= {f"{key}/{name}": values for name, values in _estimates(observed, WAYS[key]).items()}
    return found


def true_modes_nm(ramp: Scene, exposed: Exposed) -> np.ndarray:
    """Noll 2–11 of every frame's mean wavefront with the introduced defocus, (frames, 10) [nm RMS]."""
    true_nm = exposed.zernike_nm[:, :10].copy()
    true_nm[:, DEFOCUS - 2] += ramp.introduced_per_frame_nm
    return true_nm


def _estimates(observed: ObservedRamp, way: Way) -> dict[str, np.ndarray]:
    fit = observed.estimate(way)
    given = observed.knowledge[way.ncpa].ncpa_nm
    return {
        "modes_nm": fit.result.zernike_nm.numpy() + [given.get(noll, 0.0) for noll in way.modes],
        "defocus_nm": fit.defocus_nm,
        "converged": fit.result.solution.converged.numpy(),
    }


@dataclass(frozen=True)
class RampErrors:
    """How well one way did on one ramp.

    Attributes
    ----------
    slope, offset_nm : float
        Of the estimated against the introduced defocus.
    rms_nm, line_rms_nm : float
        RMS of estimated minus introduced defocus, and about the straight line.
    true_rms_nm : float
        RMS against the defocus there was: introduced, NCPAs, and the mean AO residual of the frame; the
        NCPAs that the way knows count as estimated.
    converged : float
        Part of the frames.
    """

    slope: float
    offset_nm: float
    rms_nm: float
    line_rms_nm: float
    true_rms_nm: float
    converged: float


def ramp_errors(found: Mapping[str, np.ndarray], way: str) -> RampErrors:
    """Errors of one way from the arrays of `estimate`."""
    summary = summarise(found["introduced_nm"], found[f"{way}/defocus_nm"])
    focus = WAYS[way].modes.index(DEFOCUS)
    wrong = found[f"{way}/modes_nm"][:, focus] - found["true_nm"][:, DEFOCUS - 2]
    return RampErrors(
        summary.slope,
        summary.offset_nm,
        summary.rms_nm,
        summary.residual_rms_nm,
        float(np.sqrt(np.nanmean(wrong**2))),
        float(np.mean(found[f"{way}/converged"])),
    )
