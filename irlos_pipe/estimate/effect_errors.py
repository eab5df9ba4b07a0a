"""Standard errors of the effects that a calibration estimates beside the modes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.estimate.cube import Frames, covariance_of_mean
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.frames.blocks import blocks
from irlos_pipe.numerics.solution import Solution


def effect_errors(
    frames: Frames, problem: ImageFit, solution: Solution, misfit: float
) -> dict[str, dict[str, Any]]:
    """Return the errors of the public values of the effects, by label: from the scatter of the frames.

    Of too few frames from the noise model. Both grow by the misfit.

    Parameters
    ----------
    frames : Frames
    problem : ImageFit
        Of these frames, with one member.
    solution : Solution
    misfit : float
        See `calibration_errors.errors_of`.
    """
    layout, x = problem.layout, solution.values[:1]
    if not problem.model.effects.parameters:
        return {}
    covariance = solution.covariance[0][layout.effect_values]
    if frames.show_scatter:
        _, jacobian = problem.predict_and_jacobian(x)
        weight = problem.root_weight[0].double().mean(0) ** 2
        gain = covariance @ (jacobian[0].double() * weight).cpu()
        of_effects = covariance_of_mean(responses(frames, gain).numpy())
    else:
        of_effects = covariance[:, layout.effect_values].numpy()
    return public_errors(problem.model.effects, x[0, layout.effect_values], max(1.0, misfit) * of_effects)


def public_errors(effects: EffectSet, values: torch.Tensor, covariance: np.ndarray) -> dict[str, dict]:
    """Return the errors of the public values of `effects`, by label, those without free parameters left out.

    Parameters
    ----------
    effects : EffectSet
    values : tensor, (parameters,)
        Of all free parameters.
    covariance : ndarray, (parameters, parameters)
    """
    found = {}
    for label, effect in zip(effects.labels, effects.effects, strict=True):
        columns = effects.columns_of(label)
        if columns:
            every = effect.all_values(values[columns]).numpy()
            full = np.zeros((len(every), len(every)))
            full[np.ix_(effect.free, effect.free)] = covariance[np.ix_(columns, columns)]
            found[label] = public_sigma(effect.base, every, full)
    return found


def responses(frames: Frames, gain: torch.Tensor) -> torch.Tensor:
    """Return what `gain` (parameters, pixels) makes of every frame less the mean, (frames, parameters)."""
    images, mean, flux = frames.images_e.flatten(1), frames.mean_e.flatten(), frames.flux_e[:, None]
    series = torch.empty(len(images), len(gain), dtype=torch.float64)
    for block in blocks(len(images)):
        series[block] = (images[block] * (flux.mean() / flux[block]) - mean) @ gain.mT
    return series
