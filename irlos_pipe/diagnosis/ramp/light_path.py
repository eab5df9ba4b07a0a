"""Whether a ramp's images want another light path, before its estimates are held against the focus stage.

Two models with as many free parameters each are fitted to the frames that a diagnosis may see; frames that it
may not see decide between them, each with its own tip, tilt, focus, flux and background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects.base import Effect
from irlos_pipe.estimate.ramp_fit import RampData, RampFit

COMPLETE_CHI2_NU = 1.2  # of images that a model explains; simulated ones have 1.0 within 0.1


@dataclass(frozen=True)
class Comparison:
    """Two fits of a ramp on the frames held out.

    Attributes
    ----------
    chi2_nu : (float, float)
        Mean of the frames, with the model as it was and with the candidate.
    better : float
        Part of the frames that the candidate fits better.
    significance : float
        Root of the fall of χ² per unit of the χ²/ν that the candidate leaves, which stands for the errors
        of both models.
    gap : (float, float)
        ``Σ|measured − predicted| / Σ measured``.
    """

    chi2_nu: tuple[float, float]
    better: float
    significance: float
    gap: tuple[float, float]

    @property
    def complete(self) -> bool:
        """Return whether it leaves little but noise; else estimates of the focus share its errors."""
        return self.chi2_nu[1] < COMPLETE_CHI2_NU

    def favours(self, sure: float) -> bool:
        """Return whether the candidate is `sure` σ better, and so in most of the frames."""
        return self.significance > sure and self.better > 0.5


@dataclass(frozen=True)
class LightPathName:
    """An effect on the light path that the images want.

    Attributes
    ----------
    effect : Effect
    values : sequence of float
    comparison : Comparison
    """

    effect: Effect
    values: Sequence[float]
    comparison: Comparison

    @property
    def public(self) -> dict[str, float]:
        """Its size under public names."""
        return self.effect.describe(np.array(self.values))

    @property
    def phrase(self) -> str:
        """The effect with its size, as a sentence names it."""
        return self.effect.phrase(self.public)


def compare(data: RampData, plain: RampFit, candidate: RampFit, held_out: np.ndarray) -> Comparison:
    """Compare two fits of the ramp `data` on the frames `held_out`, (frames,) of bool."""
    which = torch.as_tensor(held_out)
    before, after = (fit.result.chi2_nu[which].double() for fit in (plain, candidate))
    good = torch.isfinite(before) & torch.isfinite(after)
    before, after = before[good], after[good]
    pixels = int(data.good.sum())
    fall = float((before - after).sum()) * pixels / max(float(after.mean()), 1.0)
    gaps = [_gap(data, fit, which) for fit in (plain, candidate)]
    return Comparison(
        (float(before.mean()), float(after.mean())),
        float((after < before).double().mean()),
        float(np.sign(fall) * np.sqrt(abs(fall))),
        (gaps[0], gaps[1]),
    )


def _gap(data: RampData, fit: RampFit, which: torch.Tensor) -> float:
    images = data.images_e[which].double()[:, data.good]
    model = fit.result.model_e[which].double().reshape(len(images), *data.good.shape)[:, data.good]
    return float((images - model).abs().sum() / images.sum())
