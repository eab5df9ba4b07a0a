"""What a calibration with a 2x2 mode reports besides: what its images determine, and their centroids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.lenslets import NOLLS, identified, modes_of_centroids_nm
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.config import Config
from irlos_pipe.stages.calibrate.input import CubeInput
from irlos_pipe.stages.calibrate.results import CalibrateResults, Lenslets

TRIED_NOLLS = tuple(range(2, 46))


def with_lenslets(
    ctx: StageContext[Config], output: StageOutput, result: Calibration, cube: CubeInput
) -> StageOutput:
    """Return the `output` of a calibration with what only recordings of 2x2 modes have.

    Parameters
    ----------
    ctx : StageContext
    output : StageOutput
    result : Calibration
    cube : CubeInput
        That was calibrated.
    """
    row = _lenslets(ctx, result, cube)
    assert isinstance(output.results, CalibrateResults)
    results = output.results.model_copy(update={"lenslets": row})
    return replace(output, results=results, summary=[*output.summary, *_lines(row)])


def _lenslets(ctx: StageContext[Config], result: Calibration, cube: CubeInput) -> Lenslets:
    """Return what the images of `cube` determine beside the prior, and what their centroids say."""
    law = ctx.instrument.facility.ncpa_law
    scale = ctx.config.prior_scale or Config().prior_scale or 1.0
    known = dict(zip(result.nolls, result.fitted_modes_nm.tolist(), strict=True))
    tried = _identified(ctx, result, cube, known, TRIED_NOLLS, NcpaPrior(law, scale))
    own = _identified(ctx, result, cube, known, result.nolls, NcpaPrior(law, scale))
    per_frame = modes_of_centroids_nm(
        cube.frames.images_e.numpy(),
        cube.settings.geometry,
        cube.settings.pixel_scale_mas,
        float(np.sqrt(cube.frames.noise.floor_e2)),
    )
    count = len(per_frame)
    sigma = per_frame.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.full(len(NOLLS), np.nan)
    return Lenslets(
        modes_tried=len(TRIED_NOLLS),
        combinations=tried.combinations,
        information=tried.information.tolist(),
        determined=list(tried.determined()),
        left=dict(zip(TRIED_NOLLS, tried.left.tolist(), strict=True)),
        bound_nm=dict(zip(result.nolls, own.bound_nm.tolist(), strict=True)),
        centroids_nm=dict(zip(NOLLS, per_frame.mean(axis=0).tolist(), strict=True)),
        centroids_sigma_nm=dict(zip(NOLLS, sigma.tolist(), strict=True)),
    )


def _identified(ctx, result: Calibration, cube: CubeInput, known: dict, nolls: tuple, prior: NcpaPrior):
    psf = light_path(cube.settings, nolls, device=ctx.device, dtype=torch.float64)
    effects = [effect for effect in cube.effects if effect.plane in ("otf", "sampling")]
    model = ImageModel(psf, effects)
    labels = dict(zip(labels_of(cube.effects), cube.effects, strict=True))
    ordered = [label for one in model.effects.effects for label, e in labels.items() if e is one]
    values = [result.effect_values[label] for label in ordered]
    start = torch.as_tensor(np.concatenate([*values, np.empty(0)]))
    return identified(model, known, start, cube.frames, prior.sigma_nm(nolls).numpy())


def _lines(row: Lenslets) -> list[str]:
    return [
        f"Lenslets        by their noise the four images determine {row.combinations} of {row.modes_tried} "
        f"combinations of Noll 2–{TRIED_NOLLS[-1]}, {len(row.determined)} modes to half of their prior",
        "  speckles, and places of the images that nobody knows, leave fewer: docs/two_by_two.md",
        f"  defocus from centroids {row.centroids_nm[4]:+.1f} ± {row.centroids_sigma_nm[4]:.1f} nm, "
        f"Cramér–Rao bound of the fit {row.bound_nm.get(4, np.nan):.1f} nm",
    ]
