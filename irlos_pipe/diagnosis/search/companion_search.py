"""Where a displaced copy of the star would lower χ² most, for every shift by whole pixels at once.

A companion adds the displaced image; what it takes from the star the flux makes good. Scalar
products of all displaced images with the residual, with themselves and with the derivatives of the fitted
parameters are correlations, done by FFT.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.units import MAS
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.companion import INNER_MAS

POSITIONS = 3  # candidates to look at more closely
APART_PX = 4
RESOLVED = 1.5  # of λ/D
RING_MAS, DIRECTIONS = 150.0, 8


def brightest_copies(optimum: Optimum, effect: Effect) -> list[FixedEffect]:
    """The most promising positions of `effect` at an `optimum`, of any on the pixel grid of the window."""
    settings = optimum.settings
    gain, scale = companion_gains(optimum, effect), settings.pixel_scale_mas
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in gain.shape)
    y, x = (axis * scale for axis in np.meshgrid(rows, columns, indexing="ij"))
    inside = (np.abs(y) < settings.window[0] / 2 * scale) & (np.abs(x) < settings.window[1] / 2 * scale)
    gain[~inside | (np.hypot(x, y) < INNER_MAS)] = 0
    for x_mas, y_mas in _copies(optimum, effect):  # two that cannot be resolved are one that is no copy
        gain[np.hypot(x - x_mas, y - y_mas) < RESOLVED * _resolution_mas(optimum)] = 0
    found = []
    for _ in range(POSITIONS):
        best = np.unravel_index(np.argmax(gain), gain.shape)
        found.append(effect.displaced(x[best], y[best]))
        gain[np.hypot(x - x[best], y - y[best]) < APART_PX * scale] = 0
    return found


def _copies(optimum: Optimum, wanted: Effect) -> list[tuple[float, float]]:
    """Positions of the copies of the star that the model has where the `wanted` one would act [mas]."""
    fitted, found = optimum.fitted, []
    moments = [view.moment for view in fitted.views if wanted.acting(view.moment)]
    for effect, label in zip(fitted.effects, fitted.problem.effects.labels, strict=True):
        if effect.copies_star and any(effect.acting(moment) for moment in moments):
            _, x_mas, y_mas, *_ = fitted.values_of(label)
            found.append((x_mas, y_mas))
    return found


def _resolution_mas(optimum: Optimum) -> float:
    settings = optimum.settings
    return settings.shortest_m / settings.geometry.diameter_m / MAS


def around(effect: Effect) -> list[FixedEffect]:
    """Positions of `effect` on all sides, which say how faint a copy of the star can be seen there."""
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    return [effect.displaced(RING_MAS * np.cos(angle), RING_MAS * np.sin(angle)) for angle in angles]


def companion_gains(optimum: Optimum, effect: Effect | None = None) -> np.ndarray:
    """Fall of χ² for every shift (rows, columns), 0 first, of a window of twice the size.

    Parameters
    ----------
    optimum : Optimum
    effect : Effect, optional
        The copy of the star, which need not be in all recordings.
    """
    window, fitted = optimum.settings.window, optimum.fitted
    padded = [2 * n for n in window]
    backgrounds = torch.cat([x[0, -1:].expand(window[0] * window[1]) for _, x in fitted.recordings])
    stars = (fitted.image_e - backgrounds).reshape(-1, *window)
    root = optimum.root
    if effect is not None:
        acting = [float(effect.acting(view.moment)) for view in fitted.views]
        stars = stars * torch.tensor(acting, dtype=torch.float64)[:, None, None]

    def correlate(weights: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
        """Correlation of the parts of every recording, summed over the recordings."""
        spectra = [torch.fft.rfft2(one.reshape(-1, *window), s=padded) for one in (weights, images)]
        return torch.fft.irfft2(spectra[0] * spectra[1].conj(), s=padded).sum(0)

    projection, power = correlate(optimum.residual * root, stars), correlate(root**2, stars**2)
    imitated = sum(correlate(column * root, stars) ** 2 for column in optimum.basis.mT)
    left = (power - imitated).clamp_min(1e-3 * power.max())
    return (projection.clamp_min(0) ** 2 / left).numpy()
