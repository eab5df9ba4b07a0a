"""Where a companion would lower χ² most, for every shift by whole pixels at once.

A companion adds the displaced image; what it takes from the star the flux makes good. Scalar
products of all displaced images with the residual, with themselves and with the derivatives of the fitted
parameters are correlations, done by FFT.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.diagnose.fitting import Fitted
from irlos_pipe.diagnose.optimum import Optimum
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.companion import INNER_MAS, Companion

PLACES = 3  # candidates to look at more closely
APART_PX = 4
RING_MAS, DIRECTIONS = 150.0, 8


def brightest_companions(optimum: Optimum, candidates: list[FixedEffect]) -> list[FixedEffect]:
    """The most promising places, of any on the pixel grid within the reach of the candidates."""
    settings = optimum.fitted.problem.model.psf.settings
    gain = companion_gains(optimum, settings.window)
    scale, companion = settings.pixel_scale_mas, candidates[0].base
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in gain.shape)
    y, x = (axis * scale for axis in np.meshgrid(rows, columns, indexing="ij"))
    inside = (np.abs(y) < settings.window[0] / 2 * scale) & (np.abs(x) < settings.window[1] / 2 * scale)
    gain[~inside | (np.hypot(x, y) < INNER_MAS)] = 0
    places = []
    for _ in range(PLACES):
        best = np.unravel_index(np.argmax(gain), gain.shape)
        places.append(FixedEffect(companion, [0.0, x[best], y[best]], free=("flux_ratio",)))
        gain[np.hypot(x - x[best], y - y[best]) < APART_PX * scale] = 0
    return places


def around(companion: Companion) -> list[FixedEffect]:
    """Places at a middling distance on all sides, which tell how faint a companion can be seen there."""
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    ring = [(RING_MAS * np.cos(angle), RING_MAS * np.sin(angle)) for angle in angles]
    return [FixedEffect(companion, [0.0, x, y], free=("flux_ratio",)) for x, y in ring]


def companion_gains(optimum: Optimum, window: tuple[int, int]) -> np.ndarray:
    """Fall of χ² for every shift (rows, columns), 0 first, of a window of twice the size."""
    padded = [2 * n for n in window]
    fitted = optimum.fitted
    backgrounds = torch.cat([part[-1:].expand(window[0] * window[1]) for part in _vectors(fitted)])
    stars = (fitted.image_e - backgrounds).reshape(-1, *window)
    root = optimum.root

    def correlate(weights: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
        """Of every recording's part, summed over the recordings."""
        spectra = [torch.fft.rfft2(one.reshape(-1, *window), s=padded) for one in (weights, images)]
        return torch.fft.irfft2(spectra[0] * spectra[1].conj(), s=padded).sum(0)

    meeting, power = correlate(optimum.residual * root, stars), correlate(root**2, stars**2)
    imitated = sum(correlate(column * root, stars) ** 2 for column in optimum.basis.mT)
    left = (power - imitated).clamp_min(1e-3 * power.max())
    return (meeting.clamp_min(0) ** 2 / left).numpy()


def _vectors(fitted: Fitted) -> list[torch.Tensor]:
    """Parameters of every recording."""
    return [fitted.problem.part(fitted.x, number)[0] for number in range(len(fitted.problem.parts))]
