"""LIFT on the frames of a ramp, as the stage's settings ask for it: jointly, or as the focus loop does it."""

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects import Effect, expected
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.calibration_options import NcpaPrior
from irlos_pipe.estimate.focus.sensor import NOLLS, Focus, Limits, lift_singly
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Recording
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift, ramp_model, ramp_start
from irlos_pipe.stages.lift.stage import OWN, Config
from irlos_pipe.stages.model.effects import colour_warning, psf_settings


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
    """Estimate every frame of the `ramp`; if `calibrated`, the NCPAs of `calibrate` are known wavefront.

    The AO residual of the model, `halo`, is "calibrated", "fit" or "off". With `own_wavefront` that of the
    ramp's light is fitted to all frames. The frames `seen`, (frames,) of bool, determine what all frames
    share, by default all of them; `after` is another fit of the ramp whose dispersion, colour and own
    wavefront are taken over and not fitted once more.
    """
    if ctx.config.singly:
        return _fit_singly(ctx, ramp, calibrated=calibrated, halo=halo)
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


# -- one frame at a time: the sensor that a calibration makes ----------------------------------------


def light_path(
    ctx: StageContext[Config], recording: Recording, *, calibrated: bool = True, halo: str = "calibrated"
) -> ImageModel:
    """Return the model of single frames with tip, tilt and defocus, everything else as calibrated.

    Effects that are neither calibrated nor given values are taken as expected. `ctx`, `calibrated` and
    `halo` are as in `fit_frames`; of the `recording` only acquisition and window matter.

    Raises `ConfigurationError` for a recording of a 2x2 mode, whose images are not tabulated.
    """
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    settings = psf_settings(ctx.instrument, ctx.model, recording, ncpa_nm=ncpa_nm)
    if settings.lenslets > 1:
        raise ConfigurationError(
            f"{recording.name}: frames of 2x2 modes cannot be measured singly; set lift.singly=false"
        )
    psf = PsfModel(settings.for_single_frames(), NOLLS)
    kernel = ctx.config.object_sigma_mas
    effects = effects_for_lift(ctx, recording, halo, kernel, calibrated=calibrated)
    return ImageModel(psf, expected(effects))


def focus_sensor(
    model: ImageModel, good: np.ndarray, noise: NoiseModel, limits: Limits | None = None
) -> Focus:
    """Return the sensor with a `model`, `good` pixels, `noise` of one read and `limits`, see `Focus`.

    Raises `ConfigurationError` if the images of such a model cannot be tabulated.
    """
    try:
        return Focus(model, good, noise, limits or Limits())
    except ValueError as problem:
        raise ConfigurationError(f"single frames cannot be measured with this model: {problem}") from None


def _fit_singly(ctx: StageContext[Config], ramp: Ramp, *, calibrated: bool, halo: str) -> RampFit:
    """Estimate every frame of a `ramp` by itself; `ctx`, `calibrated` and `halo` as in `fit_frames`."""
    model = light_path(ctx, ramp.recordings[0], calibrated=calibrated, halo=halo)
    focus = focus_sensor(model, ramp.data.good.numpy(), ramp.data.noise)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        result = lift_singly(focus, ramp.data.images_e.numpy(), bar.update)
    start_nm = torch.full_like(result.zernike_nm, torch.nan)  # no start: every frame is scanned
    return RampFit(result, model, model.effects.describe(NOTHING), None, start_nm)
