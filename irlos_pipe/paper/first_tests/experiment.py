"""The paper's first test on sky, simulated: two stars, a focus stage that errs, NCPAs that nobody knows.

Target 1 is recorded in ping-pong order, so that hysteresis of the focus stage makes a saw-tooth; half of
target 2 was recorded in a second run with another reference of the stage. The truth being known here, the
lessons of the test get numbers: what the elongation prior, the kernel, more modes and the NCPAs buy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import LiftOptions, LiftResult, lift
from irlos_pipe.estimate.ramp import summarise
from irlos_pipe.estimate.ramp_fit import second_try, start_from_defocus
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.paper.common.broad_band import star_scene
from irlos_pipe.paper.common.ramps import (
    DEFOCUS,
    NINE,
    TTF,
    ObservedRamp,
    Way,
    calibrated,
    observe,
    ping_pong,
)
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.focus_ramp.experiment import RAMP_STREAM, SAMPLING, true_modes_nm
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.focus_stage import reached_nm
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene

STARTS = ("zero", "elongation", "scan", "default")


@dataclass(frozen=True)
class Target:
    """One star and how its ramp was recorded.

    Attributes
    ----------
    seeing_arcsec : float
        By MASS-DIMM, as the paper gives those of its tests on sky.
    reach_nm : (float, float)
        Ends of the ramp.
    kernel_mas : float
        σ_obj that the paper tuned by hand.
    hysteresis_nm : float
        The stage stops this much beyond where it was told, in the direction of travel.
    second_run_bias_nm : float
        Reference of the run that recorded the positive half against the other run.
    """

    label: str
    mag_j: float
    seeing_arcsec: float
    reach_nm: tuple[float, float]
    kernel_mas: float
    hysteresis_nm: float = 0.0
    second_run_bias_nm: float = 0.0

    @property
    def stage_effects(self) -> dict[str, dict[str, float]]:
        """Errors of the focus stage as effects of a scene."""
        effects = {
            "focus_stage_hysteresis": {"nm": self.hysteresis_nm},
            "focus_stage_offset": {"nm": self.second_run_bias_nm, "above_nm": 0.0},
        }
        return {name: effect for name, effect in effects.items() if effect["nm"]}

    def order(self, offsets: int) -> np.ndarray:
        """Offsets in the order of recording: ping-pong where the paper says so, else from end to end."""
        ascending = np.linspace(*self.reach_nm, offsets)
        return ping_pong(ascending) if self.hysteresis_nm else ascending


TARGETS = {
    "target_1": Target("target 1", 9.0, 0.5, (-432.0, 467.0), 12.0, hysteresis_nm=15.0),
    "target_2": Target("target 2", 12.5, 1.5, (-302.0, 288.0), 14.5, second_run_bias_nm=40.0),
}


def ways_of(target: Target) -> dict[str, Way]:
    """The ways to estimate a target: the kernel without NCPAs, then what the NCPAs buy."""
    by_hand = {"halo": "off", "kernel": target.kernel_mas}
    text = f"kernel {target.kernel_mas:g} mas by hand"
    return {
        "point_9": Way("no kernel", NINE, halo="off", kernel=0.0),
        "hand_3": Way(text, TTF, **by_hand),
        "hand_9": Way(text, NINE, **by_hand),
        "fit_9": Way("kernel fitted to the ramp", NINE, halo="off", kernel="fit"),
        "residual_3": Way("AO residual and jitter as expected", TTF),
        "residual_9": Way("AO residual and jitter as expected", NINE),
        "ncpa_hand_3": Way(f"NCPAs, {text}", TTF, ncpa=DEFAULT, **by_hand),
        "default_3": Way("NCPAs, AO residual and jitter as calibrated", TTF, ncpa=DEFAULT),
        "default_9": Way("NCPAs, AO residual and jitter as calibrated", NINE, ncpa=DEFAULT),
    }


WAYS = tuple(ways_of(TARGETS["target_1"]))
STARTED = ("hand_9", "default_3")  # the paper's way and this project's, begun from every start


@dataclass(frozen=True)
class TargetSample:
    """One set of NCPAs for one of the `TARGETS`.

    Attributes
    ----------
    target : str
        Key of `TARGETS`.
    seeing_arcsec : float
        On SPARTA's scale.
    ncpa_nm : float
        NCPAs over 50 modes [nm RMS].
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    target: str
    seeing_arcsec: float
    offsets: int
    frames_per_offset: int
    cube_frames: int
    ncpa_nm: float


def scenes_of(sample: TargetSample) -> tuple[Scene, Scene]:
    """Calibration cube and ramp of a sample, both under the seeing of the target."""
    target = TARGETS[sample.target]
    ncpa_nm = draw_ncpa_nm(np.random.default_rng(sample.seed), sample.facility.ncpa_law, sample.ncpa_nm)
    conditions = Sample(
        sample.name,
        sample.seed,
        sample.facility,
        sample.seeing_arcsec,
        "power_law",
        sample.cube_frames,
        (),
    )
    cube = replace(scene_of(conditions), ncpa_nm=ncpa_nm, sampling=SAMPLING)
    introduced_nm = tuple(np.repeat(target.order(sample.offsets), sample.frames_per_offset).tolist())
    ramp = star_scene(
        sample.name,
        sample.facility,
        (*sample.seed, RAMP_STREAM),
        len(introduced_nm),
        target.mag_j,
        ncpa_nm,
        introduced_nm,
        seeing_arcsec=sample.seeing_arcsec,
    )
    return cube, replace(ramp, sampling=SAMPLING, effects=target.stage_effects)


def estimate(sample: TargetSample) -> dict[str, np.ndarray]:
    """Simulate a target and estimate its ramp in every way and from every start.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm``, ``reached_nm`` and ``true_nm`` (frames,): defocus as told to the stage, as
        the stage introduced it, and as the mean wavefront of the frame has it, NCPAs included;
        ``ncpa_nm`` the defocus among the NCPAs. For every way ``<way>/defocus_nm`` (frames,),
        ``<way>/given_nm`` (the defocus among the NCPAs given to it), ``<way>/converged`` (frames,) and
        ``<way>/kernel_mas``. For the ways of `STARTED` also ``<way>/<start>/wrong`` and ``/iterations``
        (frames,).
    """
    cube, ramp = scenes_of(sample)
    exposed = expose(ramp)
    observed = observe(ramp, exposed, calibrated(cube, [DEFAULT]))
    told = ramp.introduced_per_frame_nm
    found = {
        "introduced_nm": told,
        "reached_nm": reached_nm(told, ramp.effects, ramp.rng("focus_stage")),
        "true_nm": true_modes_nm(ramp, exposed)[:, DEFOCUS - 2],
        "ncpa_nm": np.array(ramp.ncpa_nm[DEFOCUS]),
    }
    for key, way in ways_of(TARGETS[sample.target]).items():
        found |= {f"{key}/{name}": value for name, value in _estimates(observed, way).items()}
        if key in STARTED:
            found |= {f"{key}/{name}": value for name, value in _from_every_start(observed, way).items()}
    return found


def _estimates(observed: ObservedRamp, way: Way) -> dict[str, np.ndarray]:
    fit = observed.estimate(way)
    return {
        "defocus_nm": fit.defocus_nm,
        "given_nm": np.array(observed.given_defocus_nm(way)),
        "converged": fit.result.solution.converged.numpy(),
        "kernel_mas": np.array(fit.effects.get("tip_tilt_jitter", {}).get("sigma_mas", np.nan)),
    }


# -- what the start buys ---------------------------------------------------------------------------


def _from_every_start(observed: ObservedRamp, way: Way) -> dict[str, np.ndarray]:
    """Whether LIFT ends in the best minimum found, and after how many iterations.

    ``default`` is the elongation prior with a second try of outlying frames from the scan.
    """
    psf, data, options = observed.model(way), observed.data, LiftOptions("data")
    model = ImageModel(psf, observed.effects(way))
    starts = {
        "zero": start_from_defocus(psf, data, np.zeros(len(data.introduced_nm))),
        "elongation": observed.start_nm(way, psf),
        "scan": scan_start_nm(psf, data.images_e, data.pixel_mask, model.optics),
    }
    results = {
        name: lift(model, data.images_e, data.pixel_mask, data.noise, start, options)
        for name, start in starts.items()
    }
    results["default"] = second_try(model, data, results["elongation"], options)
    wrong = wrong_minima(results)
    return {f"{name}/wrong": wrong[name] for name in results} | {
        f"{name}/iterations": result.solution.iterations.numpy() for name, result in results.items()
    }


def wrong_minima(results: Mapping[str, LiftResult], apart_nm: float = 50.0) -> dict[str, np.ndarray]:
    """Frames that did not converge, or lie `apart_nm` from the best of all starts, (frames,) per start."""
    defocus = torch.stack([result.mode(DEFOCUS)[0] for result in results.values()])
    converged = torch.stack([result.solution.converged for result in results.values()])
    chi2 = torch.stack([result.chi2_nu for result in results.values()])
    best = torch.where(converged, chi2, torch.inf).argmin(0)
    apart = (defocus - defocus.gather(0, best[None])).abs() > apart_nm
    return dict(zip(results, (~converged | apart).numpy(), strict=True))


# -- what comes out --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TargetErrors:
    """How well one way did on one ramp.

    Attributes
    ----------
    slope : float
        Of the estimate against the defocus that the stage reached.
    rms_nm : float
        RMS of the estimate, the defocus given with the NCPAs included, minus the true defocus of each frame.
    line_rms_nm : float
        RMS about a straight line through the reached defocus.
    converged : float
        Part of the frames.
    """

    slope: float
    rms_nm: float
    line_rms_nm: float
    converged: float


def target_errors(found: Mapping[str, np.ndarray], way: str) -> TargetErrors:
    """Errors of one way from the arrays of `estimate`."""
    estimated = found[f"{way}/defocus_nm"]
    summary = summarise(found["reached_nm"], estimated)
    wrong = estimated + found[f"{way}/given_nm"] - found["true_nm"]
    return TargetErrors(
        summary.slope,
        float(np.sqrt(np.nanmean(wrong**2))),
        summary.residual_rms_nm,
        float(np.mean(found[f"{way}/converged"])),
    )


@dataclass(frozen=True)
class StageError:
    """Error of the focus stage, as a user finds it who knows only what the stage was told [nm RMS]."""

    true_nm: float
    found_nm: float
    sigma_nm: float


def stage_error(found: Mapping[str, np.ndarray], way: str, target: Target) -> StageError:
    """Saw-tooth of target 1 (twice the hysteresis), or bias of the second run of target 2."""
    introduced, estimated = found["introduced_nm"], found[f"{way}/defocus_nm"]
    if target.hysteresis_nm:
        summary = summarise(introduced, estimated)
        return StageError(2 * target.hysteresis_nm, summary.saw_tooth_nm, summary.saw_tooth_sigma_nm)
    summary = summarise(introduced, estimated, introduced > 0)
    return StageError(target.second_run_bias_nm, summary.part_bias_nm, summary.part_bias_sigma_nm)
