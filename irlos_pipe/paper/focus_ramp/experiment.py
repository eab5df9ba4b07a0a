"""A focus ramp with and without calibrated NCPAs (paper, Fig. "Calibrated LIFT").

The NCPAs of a sample are calibrated from a cube of the narrow H band; the ramp of the same star in J+H
has the same NCPAs and other residuals. Every variant of LIFT sees the same frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.estimate.ramp import summarise
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ramps import (
    DEFOCUS,
    LIFT_VARIANTS,
    LiftVariant,
    ObservedRamp,
    calibrated,
    methods_of,
    observe,
    ramp_scene,
    true_modes_nm,
)
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene


@dataclass(frozen=True)
class RampSample:
    """One set of NCPAs: a cube to calibrate them, and a ramp.

    Attributes
    ----------
    offsets_nm : tuple of float
        Introduced defocus.
    variants : tuple of str
        Keys of `LIFT_VARIANTS`.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    offsets_nm: tuple[float, ...]
    frames_per_offset: int
    cube_frames: int
    variants: tuple[str, ...]
    seeing_arcsec: float
    cube_mag_j: float
    ramp_mag_j: float


def scenes_of(sample: RampSample) -> tuple[Scene, Scene]:
    """Return calibration cube and ramp of a sample."""
    cube = CubeSample(
        sample.name, sample.seed, sample.facility, sample.seeing_arcsec, sample.cube_frames, sample.cube_mag_j
    )
    scene = replace(cube.scene(), sampling=FINE)
    introduced_nm = np.repeat(sample.offsets_nm, sample.frames_per_offset).tolist()
    return scene, ramp_scene(scene, sample.ramp_mag_j, introduced_nm)


def estimate(sample: RampSample) -> dict[str, np.ndarray]:
    """Simulate cube and ramp of a sample and estimate the ramp by every variant of LIFT.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm`` (frames,); ``true_nm`` (frames, 10), Noll 2–11 of the frame's own mean wavefront,
        introduced defocus included, diversity not; and for every variant ``<variant>/modes_nm``
        (frames, modes) the same modes as estimated, the NCPAs given to it included,
        ``<variant>/defocus_nm`` (frames,) its estimate without them, and ``<variant>/converged``.
    """
    cube, ramp = scenes_of(sample)
    variants = {key: LIFT_VARIANTS[key] for key in sample.variants}
    exposed = expose(ramp)
    observed = observe(ramp, exposed, calibrated(cube, methods_of(variants.values())))
    found = {"introduced_nm": ramp.introduced_per_frame_nm, "true_nm": true_modes_nm(ramp, exposed)}
    for key, variant in variants.items():
        found |= {f"{key}/{name}": values for name, values in _estimates(observed, variant).items()}
    return found


def _estimates(observed: ObservedRamp, variant: LiftVariant) -> dict[str, np.ndarray]:
    fit = observed.estimate(variant)
    given = observed.knowledge[variant.ncpa].ncpa_nm
    return {
        "modes_nm": fit.result.zernike_nm.numpy() + [given.get(noll, 0.0) for noll in variant.modes],
        "defocus_nm": fit.defocus_nm,
        "converged": fit.result.solution.converged.numpy(),
    }


@dataclass(frozen=True)
class RampErrors:
    """Errors of one variant on one ramp.

    Attributes
    ----------
    slope, offset_nm : float
        Of the estimated against the introduced defocus.
    rms_nm, line_rms_nm : float
        RMS of estimated minus introduced defocus, and about the straight line.
    true_rms_nm : float
        RMS against the defocus there was: introduced, NCPAs, and the mean AO residual of the frame; the
        NCPAs that the variant knows count as estimated.
    converged : float
        Part of the frames.
    """

    slope: float
    offset_nm: float
    rms_nm: float
    line_rms_nm: float
    true_rms_nm: float
    converged: float


def ramp_errors(found: Mapping[str, np.ndarray], key: str) -> RampErrors:
    """Return the errors of the variant `key` from the arrays `found` by `estimate`."""
    summary = summarise(found["introduced_nm"], found[f"{key}/defocus_nm"])
    focus = LIFT_VARIANTS[key].modes.index(DEFOCUS)
    wrong = found[f"{key}/modes_nm"][:, focus] - found["true_nm"][:, DEFOCUS - 2]
    return RampErrors(
        summary.slope,
        summary.offset_nm,
        summary.rms_nm,
        summary.residual_rms_nm,
        float(np.sqrt(np.nanmean(wrong**2))),
        float(np.mean(found[f"{key}/converged"])),
    )
