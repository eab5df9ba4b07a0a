"""Whether the noise is what the noise model says, from frames alone, before any model is fitted.

Differences of successive frames hold the noise twice and nothing that stands still. What flux and
pointing do from frame to frame is projected out with the mean image and its gradients. Photon noise
follows the signal with the excess-noise factor; speckles of an AO residual exceed it where it is bright.
"""

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stack
from irlos_pipe.diagnosis.records import NoiseVerdict

FAINT, BRIGHT = 0.5, 0.02  # share of the pixels that are faint; of the peak, from which pixels are bright
SPECKLE = 1.3  # measured over predicted variance of bright pixels from which speckles set the scatter
TOLERANCE = 0.3  # relative deviation of a variance within which the noise model holds
PHOTONS, SPECKLES, UNSEEN = "photon-limited", "speckle-limited", "unseen"


def judge_all(stacks: Sequence[Stack]) -> NoiseVerdict:
    """Noise verdict of the recording that deviates most from the noise model; speckles take precedence."""
    found = [judge_noise(stack) for stack in stacks]
    found = [one for one in found if one.kind != UNSEEN] or found[:1]
    found = [one for one in found if one.kind == SPECKLES] or found
    return max(found, key=lambda one: abs(np.log(max(one.bright_ratio, 1e-9))))


def judge_noise(stack: Stack) -> NoiseVerdict:
    """Compare variances with the noise model's."""
    if len(stack) < 2:
        return NoiseVerdict(UNSEEN, text="as declared: one frame shows no scatter")
    images = stack.frames.images_e.double().numpy()
    good = stack.frames.good.numpy()
    mean = images.mean(0)
    differences = np.diff(images, axis=0).reshape(len(images) - 1, -1)
    shapes = np.stack([mean, *np.gradient(mean), np.ones_like(mean)]).reshape(4, -1)
    basis = np.linalg.qr(shapes.T)[0]
    quiet = differences - (differences @ basis) @ basis.T
    measured = (quiet**2).mean(0).reshape(mean.shape) / 2
    predicted = stack.frames.noise.scatter_e2(torch.as_tensor(mean)).numpy()
    bright = good & (mean > BRIGHT * mean.max())
    faint = good & (mean < np.quantile(mean[good], FAINT))
    ratios = [float(measured[where].sum() / predicted[where].sum()) for where in (bright, faint)]
    return _verdict(SPECKLES if ratios[0] > SPECKLE else PHOTONS, *ratios)


def _verdict(kind: str, in_bright: float, in_faint: float) -> NoiseVerdict:
    """It holds if nothing is quieter than the noise model, nor louder without speckles to blame."""
    quietest = min(in_faint, in_bright)
    holds = quietest > 1 - TOLERANCE and (kind != PHOTONS or in_faint < 1 + TOLERANCE)
    ratios = f"{in_bright:.2f} in bright, {in_faint:.2f} in faint pixels"
    text = f"{kind}, variance over prediction {ratios}"
    return NoiseVerdict(
        kind, in_bright, in_faint, holds, text if holds else f"{text}; the noise model does not hold"
    )
