"""Which other names these data allow beside the best one, and what would separate them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.held_out import HeldOutEvaluation, preference
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import Alternative
from irlos_pipe.diagnosis.refit import CLEARLY_LESS, EXPLAINS_AS_MUCH, Refit

SURE = 3.0  # Vuong's statistic on the held-out frames
LIKENESS = 0.9
LARGEST_SET = 3


def alternatives(ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]) -> list[Alternative]:
    """Names that are not significantly worse than the first of `ranked`.

    `judges`: the evaluation of each on the held-out frames.
    """
    best = ranked[0]
    found = []
    for other, judge in zip(ranked[1:], judges[1:], strict=True):
        z = preference(judges[0], judge)
        deficit = (other.fitted.chi2 - best.fitted.chi2) / best.score.inflation
        if deficit < CLEARLY_LESS or (z < SURE and other.gain > EXPLAINS_AS_MUCH * best.gain):
            found.append(_alternative(best, other, z))
    return sorted(found, key=lambda one: -one.likeness)[: LARGEST_SET - 1]


def likeness(one: Fitted, other: Fitted, before: Optimum) -> float:
    """|cos| of the changes of the image that models `one` and `other` make.

    They are projected off the fitted parameters of the model `before`.
    """
    changes = torch.stack(
        [(fitted.image_e - before.fitted.image_e) * before.root for fitted in (one, other)], dim=1
    )
    gram = before.norm2(changes)
    return float(gram[0, 1].abs() / (gram[0, 0] * gram[1, 1]).clamp_min(1e-300).sqrt())


def _alternative(best: Refit, other: Refit, z: float) -> Alternative:
    cosine = likeness(best.fitted, other.fitted, best.origin)
    alike = "they change the image alike" if cosine > LIKENESS else "both explain the excess as well"
    reason = f"{alike} (|cos| {cosine:.3f}), and the held-out frames do not decide (z {z:.1f})"
    return Alternative(other.name, reason, best.base.look_alike, cosine)
