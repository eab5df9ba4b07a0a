"""LIFT on the frames of a ramp, as the stage's settings ask for it."""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects import Effect
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.effects.labels import labels_of
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.lift.config import Config
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift, ramp_model, ramp_start
from irlos_pipe.stages.lift.singly import fit_singly
from irlos_pipe.stages.model.colour import colour_warning


def fit_frames(
    ctx: StageContext[Config],
    ramp: Ramp,
    *,
    calibrated: bool,
    halo: str,
    seen: np.ndarray | None = None,
    after: RampFit | None = None,
) -> RampFit:
    """Estimate every frame of the `ramp`.

    Parameters
    ----------
    ctx : StageContext
    ramp : Ramp
    calibrated : bool
        Whether the NCPAs of `calibrate` are a part of the known wavefront.
    halo : {"calibrated", "fit", "off"}
        AO residual in the model.
    seen : ndarray of bool, (frames,), optional
        Frames that determine what all frames share; by default all of them.
    after : RampFit, optional
        Another fit of the ramp, whose dispersion and colour are taken over and not fitted once more.
    """
    if ctx.config.singly:
        return fit_singly(ctx, ramp, calibrated=calibrated, halo=halo)
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, ctx.config.modes, ncpa_nm)
    recording, kernel = ramp.recordings[0], ctx.config.object_sigma_mas
    effects = effects_for_lift(ctx, recording, halo, kernel, calibrated=calibrated)
    effects = effects if after is None else _with_colour_of(after, effects)
    if after is None and (warning := colour_warning(effects, ramp.recordings)):
        ctx.log.warning(warning)
    if ctx.config.common_modes:
        effects.append(HighOrderNcpa(ctx.config.common_modes))
    start = ramp_start(ctx, model, ramp, ncpa_nm, ctx.config.start)
    options = _options(ctx.config, ctx.instrument.facility.ncpa_law, start)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        return fit_ramp(model, ramp.data, start, options, effects, seen=seen, report=bar.update)


def _with_colour_of(found: RampFit, effects: list[Effect]) -> list[Effect]:
    """Effects with dispersion and colour held as another fit `found` them."""
    known = found.model.general.effects
    held = dict(zip(known.labels, known.effects, strict=True))
    colour = (AtmosphericDispersion, Spectrum)
    return [
        held.get(label, effect) if isinstance(effect.base, colour) else effect
        for label, effect in zip(labels_of(effects), effects, strict=True)
    ]


def _options(config: Config, ncpa_law: NcpaLaw, start_nm: torch.Tensor) -> LiftOptions:
    """ML, or MAP about the start's defocus and zero for the other modes."""
    if config.estimator == "ml":
        return LiftOptions(config.noise, max_iterations=config.max_iterations, loss=config.loss)
    mean = torch.zeros_like(start_nm)
    focus = config.modes.index(4)
    mean[:, focus] = start_nm[:, focus]
    sigma_nm = NcpaPrior(ncpa_law, config.prior_scale).sigma_nm(config.modes)
    return LiftOptions(config.noise, mean, sigma_nm, config.max_iterations, config.loss)
