"""LIFT on the frames of a ramp, as the stage's settings ask for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects import Effect
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.lift.config import Config
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift, ramp_model, ramp_start
from irlos_pipe.stages.lift.own_wavefront import OWN
from irlos_pipe.stages.lift.singly import fit_singly
from irlos_pipe.stages.model.colour import colour_warning


def fit_frames(
    ctx: StageContext[Config],
    ramp: Ramp,
    *,
    calibrated: bool,
    halo: str,
    own_wavefront: bool = False,
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
    own_wavefront : bool
        Whether that of the ramp's light is fitted to all frames, see `own_wavefront`.
    seen : ndarray of bool, (frames,), optional
        Frames that determine what all frames share; by default all of them.
    after : RampFit, optional
        Another fit of the ramp, whose dispersion, colour and own wavefront are taken over and not fitted
        once more.
    """
    if ctx.config.singly:
        return fit_singly(ctx, ramp, calibrated=calibrated, halo=halo)
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, ctx.config.modes, ncpa_nm)
    recording, kernel = ramp.recordings[0], ctx.config.object_sigma_mas
    own_wavefront |= after is not None and any(isinstance(one.base, OWN) for one in _effects_of(after))
    effects = effects_for_lift(
        ctx, recording, halo, kernel, calibrated=calibrated, own_wavefront=own_wavefront
    )
    effects = effects if after is None else _with_light_of(after, effects)
    first = after is None and (not own_wavefront or ctx.config.own_wavefront == "always")
    if first and (warning := colour_warning(effects, ramp.recordings)):
        ctx.log.warning(warning)
    if ctx.config.common_modes:
        effects.append(HighOrderNcpa(ctx.config.common_modes))
    start = ramp_start(ctx, model, ramp, ncpa_nm, ctx.config.start)
    options = _options(ctx.config, ctx.instrument.facility.ncpa_law, start)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        return fit_ramp(model, ramp.data, start, options, effects, seen=seen, report=bar.update)


def _effects_of(fit: RampFit) -> Sequence[Effect]:
    return fit.model.general.effects.effects


def _with_light_of(found: RampFit, effects: list[Effect]) -> list[Effect]:
    """Effects with dispersion, colour and own wavefront held as another fit `found` them."""
    held = dict(zip(found.model.general.effects.labels, _effects_of(found), strict=True))
    light = (AtmosphericDispersion, Spectrum, *OWN)
    return [
        held.get(label, effect) if isinstance(effect.base, light) else effect
        for label, effect in zip(labels_of(effects), effects, strict=True)
        if label in held or not isinstance(effect.base, OWN)
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
