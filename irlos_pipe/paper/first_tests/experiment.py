"""The paper's first test on sky, simulated: two stars, a focus stage with errors, unknown NCPAs.

Target 1 is recorded in ping-pong order, so that hysteresis of the focus stage makes a saw-tooth; half of
target 2 was recorded in a second run with another reference of the stage. The truth being known here, the
lessons of the test get numbers: the gain by elongation prior, kernel, more modes and NCPAs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp import summarise
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import BRIGHT_MAG_J, CubeSample
from irlos_pipe.paper.common.ramps import (
    DEFOCUS,
    KERNEL_MAS,
    NINE,
    TTF,
    LiftVariant,
    ObservedRamp,
    calibrated,
    from_every_start,
    observe,
    ping_pong,
    ramp_scene,
    true_modes_nm,
)
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.simulate.effects.catalogue import effects_of
from irlos_pipe.simulate.effects.focus_stage import reached_nm
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene

WRONG_NM = 50.0  # an estimate this far from the best minimum lies in another one


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
        The stage stops this much beyond the commanded position, in the direction of travel.
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
        """Return the errors of the focus stage as effects of a scene."""
        effects = {
            "focus_stage_hysteresis": {"nm": self.hysteresis_nm},
            "focus_stage_offset": {"nm": self.second_run_bias_nm, "above_nm": 0.0},
        }
        return {name: effect for name, effect in effects.items() if effect["nm"]}

    def order(self, offsets: int) -> np.ndarray:
        """Return the offsets in the order of recording: ping-pong, or from end to end."""
        ascending = np.linspace(*self.reach_nm, offsets)
        return ping_pong(ascending.tolist()) if self.hysteresis_nm else ascending


TARGETS = {
    "target_1": Target("target 1", 9.0, 0.5, (-432.0, 467.0), KERNEL_MAS, hysteresis_nm=15.0),
    "target_2": Target("target 2", 12.5, 1.5, (-302.0, 288.0), 14.5, second_run_bias_nm=40.0),
}


def variants_of(target: Target) -> dict[str, LiftVariant]:
    """Return the variants of LIFT for a target: the kernel without NCPAs, then with the NCPAs."""
    text = f"kernel {target.kernel_mas:g} mas by hand"
    by_hand = LiftVariant(text, NINE, halo="off", kernel=target.kernel_mas)
    residual = LiftVariant("AO residual and jitter as expected", NINE)
    default = LiftVariant("NCPAs, AO residual and jitter as calibrated", NINE, ncpa=DEFAULT)
    return {
        "point_9": LiftVariant("no kernel", NINE, halo="off", kernel=0.0),
        "hand_3": replace(by_hand, modes=TTF),
        "hand_9": by_hand,
        "fit_9": LiftVariant("kernel fitted to the ramp", NINE, halo="off", kernel="fit"),
        "residual_3": replace(residual, modes=TTF),
        "residual_9": residual,
        "ncpa_hand_3": replace(by_hand, name=f"NCPAs, {text}", modes=TTF, ncpa=DEFAULT),
        "default_3": replace(default, modes=TTF),
        "default_9": default,
    }


VARIANT_KEYS = tuple(variants_of(TARGETS["target_1"]))
STARTED = ("hand_9", "default_3")  # the paper's variant and this project's, begun from every start


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
    """Return calibration cube and ramp of a sample, both under the seeing of the target."""
    target = TARGETS[sample.target]
    ncpa_nm = draw_ncpa_nm(np.random.default_rng(sample.seed), sample.facility.ncpa_law, sample.ncpa_nm)
    conditions = CubeSample(
        sample.name, sample.seed, sample.facility, sample.seeing_arcsec, sample.cube_frames, BRIGHT_MAG_J
    )
    cube = replace(conditions.scene(), ncpa_nm=ncpa_nm, sampling=FINE)
    introduced_nm = np.repeat(target.order(sample.offsets), sample.frames_per_offset).tolist()
    ramp = ramp_scene(cube, target.mag_j, introduced_nm)
    return cube, replace(ramp, effects=target.stage_effects)


def estimate(sample: TargetSample) -> dict[str, np.ndarray]:
    """Simulate a target and estimate its ramp by every variant and from every start.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm``, ``reached_nm`` and ``true_nm`` (frames,): defocus as commanded, as the stage
        introduced it, and as the mean wavefront of the frame has it, NCPAs included; ``ncpa_nm`` the
        defocus among the NCPAs. For every variant ``<variant>/defocus_nm`` (frames,),
        ``<variant>/given_nm`` (the defocus among the NCPAs given to it), ``<variant>/converged``
        (frames,) and ``<variant>/kernel_mas``. For `STARTED` also ``<variant>/<start>/wrong`` and
        ``/iterations`` (frames,).
    """
    cube, ramp = scenes_of(sample)
    exposed = expose(ramp)
    observed = observe(ramp, exposed, calibrated(cube, [DEFAULT]))
    commanded_nm = ramp.introduced_per_frame_nm
    found = {
        "introduced_nm": commanded_nm,
        "reached_nm": reached_nm(commanded_nm, effects_of(ramp.effects), ramp.rng("focus_stage")),
        "true_nm": true_modes_nm(ramp, exposed)[:, DEFOCUS - 2],
        "ncpa_nm": np.array(ramp.ncpa_nm[DEFOCUS]),
    }
    for key, variant in variants_of(TARGETS[sample.target]).items():
        found |= {f"{key}/{name}": value for name, value in _estimates(observed, variant).items()}
        if key in STARTED:
            found |= {f"{key}/{name}": value for name, value in _started(observed, variant).items()}
    return found


def _estimates(observed: ObservedRamp, variant: LiftVariant) -> dict[str, np.ndarray]:
    fit = observed.estimate(variant)
    return {
        "defocus_nm": fit.defocus_nm,
        "given_nm": np.array(observed.given_defocus_nm(variant)),
        "converged": fit.result.solution.converged.numpy(),
        "kernel_mas": np.array(fit.effects.get("tip_tilt_jitter", {}).get("sigma_mas", np.nan)),
    }


# -- influence of the start -----------------------------------------------------------------------


def _started(observed: ObservedRamp, variant: LiftVariant) -> dict[str, np.ndarray]:
    """Whether LIFT ends in the best minimum found, and after how many iterations, from every start."""
    model = ImageModel(observed.model(variant), observed.effects(variant))
    elongation_nm = observed.start_nm(variant, model.psf)
    found = from_every_start(model, observed.data, elongation_nm, LiftOptions("data"))
    results = {name: result for name, (_, result) in found.items()}
    wrong = wrong_minima(results)
    return {f"{name}/wrong": wrong[name] for name in results} | {
        f"{name}/iterations": result.solution.iterations.numpy() for name, result in results.items()
    }


def wrong_minima(results: Mapping[str, LiftResult]) -> dict[str, np.ndarray]:
    """Return which frames did not converge or lie far from the best of all starts, (frames,) per start."""
    defocus = torch.stack([result.mode(DEFOCUS)[0] for result in results.values()])
    converged = torch.stack([result.solution.converged for result in results.values()])
    chi2 = torch.stack([result.chi2_nu for result in results.values()])
    best = torch.where(converged, chi2, torch.inf).argmin(0)
    apart = (defocus - defocus.gather(0, best[None])).abs() > WRONG_NM
    return dict(zip(results, (~converged | apart).numpy(), strict=True))


# -- what comes out --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TargetErrors:
    """Errors of one variant on one ramp.

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


def target_errors(found: Mapping[str, np.ndarray], key: str) -> TargetErrors:
    """Return the errors of the variant `key` from the arrays `found` by `estimate`."""
    estimated = found[f"{key}/defocus_nm"]
    summary = summarise(found["reached_nm"], estimated)
    wrong = estimated + found[f"{key}/given_nm"] - found["true_nm"]
    return TargetErrors(
        summary.slope,
        float(np.sqrt(np.nanmean(wrong**2))),
        summary.residual_rms_nm,
        float(np.mean(found[f"{key}/converged"])),
    )


@dataclass(frozen=True)
class StageError:
    """Error of the focus stage as found by a user who knows the commanded defocus only [nm RMS]."""

    true_nm: float
    found_nm: float
    sigma_nm: float


def stage_error(found: Mapping[str, np.ndarray], key: str, target: Target) -> StageError:
    """Return the saw-tooth of target 1 (twice the hysteresis), or the bias of the second run of target 2.

    The estimates are those of the variant `key` among the arrays `found` by `estimate`; `target` has the
    true error.
    """
    introduced, estimated = found["introduced_nm"], found[f"{key}/defocus_nm"]
    if target.hysteresis_nm:
        summary = summarise(introduced, estimated)
        return StageError(2 * target.hysteresis_nm, summary.saw_tooth_nm, summary.saw_tooth_sigma_nm)
    summary = summarise(introduced, estimated, introduced > 0)
    return StageError(target.second_run_bias_nm, summary.part_bias_nm, summary.part_bias_sigma_nm)
