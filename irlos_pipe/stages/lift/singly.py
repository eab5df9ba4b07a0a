"""LIFT as the focus loop does it: the sensor that a calibration makes, and a ramp measured with it."""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.effects import expected
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.estimate.focus.sensor import NOLLS, Focus, Limits, lift_singly
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Recording
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.lift.config import Config
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift
from irlos_pipe.stages.model.recording_settings import psf_settings


def light_path(
    ctx: StageContext[Config], recording: Recording, *, calibrated: bool = True, halo: str = "calibrated"
) -> ImageModel:
    """Return the model of single frames with tip, tilt and defocus, everything else as calibrated.

    Effects that are neither calibrated nor given values are taken as expected.

    Parameters
    ----------
    ctx : StageContext
    recording : Recording
        Its acquisition and window; its frames do not matter.
    calibrated, halo
        See `fit_frames`.

    Raises
    ------
    ConfigurationError
        For a recording of a 2x2 mode, whose images are not tabulated.
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

    Raises
    ------
    ConfigurationError
        If the images of such a model cannot be tabulated.
    """
    try:
        return Focus(model, good, noise, limits or Limits())
    except ValueError as problem:
        raise ConfigurationError(f"single frames cannot be measured with this model: {problem}") from None


def fit_singly(ctx: StageContext[Config], ramp: Ramp, *, calibrated: bool, halo: str) -> RampFit:
    """Estimate every frame of a `ramp` by itself; `ctx`, `calibrated` and `halo` as in `fit_frames`."""
    model = light_path(ctx, ramp.recordings[0], calibrated=calibrated, halo=halo)
    focus = focus_sensor(model, ramp.data.good.numpy(), ramp.data.noise)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        result = lift_singly(focus, ramp.data.images_e.numpy(), bar.update)
    start_nm = torch.full_like(result.zernike_nm, torch.nan)  # no start: every frame is scanned
    return RampFit(result, model, model.effects.describe(NOTHING), None, start_nm)
