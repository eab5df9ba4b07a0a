"""Defects of the detector that the dark, the flat and the map of dead pixels do not show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

BAD_LEVEL_E = 1000.0  # of hot and stuck pixels when the effect gives none


@dataclass(frozen=True)
class LateDefects:
    """Defects that came after the calibration images were taken, or that they cannot show.

    Attributes
    ----------
    hot_e : ndarray, (rows, columns)
        Mean charge of hot pixels per frame [e-].
    alive : ndarray, (rows, columns)
        0 in pixels that died.
    stuck_e : ndarray, (rows, columns)
        Constant reading above the pedestal; NaN where the pixel works [e-].
    background_e : ndarray, (rows, columns)
        What is left of pedestal or background [e-].
    """

    hot_e: np.ndarray
    alive: np.ndarray
    stuck_e: np.ndarray
    background_e: np.ndarray

    @classmethod
    def of(cls, effects: Mapping[str, Mapping], window: tuple[int, int]) -> LateDefects:
        """Of the effects `bad_pixels` and `background_gradient`."""
        bad = effects.get("bad_pixels", {})
        kind, level_e = bad.get("kind", "hot"), bad.get("level_e", BAD_LEVEL_E)
        is_bad = marked(bad.get("pixels", ()), window)
        return cls(
            np.where(is_bad & (kind == "hot"), level_e, 0.0),
            np.where(is_bad & (kind == "dead"), 0.0, 1.0),
            np.where(is_bad & (kind == "stuck"), level_e, np.nan),
            gradient_e(effects.get("background_gradient", {}), window),
        )

    def read(self, values: np.ndarray, stuck: np.ndarray) -> np.ndarray:
        """Put the constant readings of stuck pixels into frames (..., rows, columns)."""
        return np.where(np.isnan(self.stuck_e), values, stuck)


def gradient_e(effect: Mapping[str, float], window: tuple[int, int]) -> np.ndarray:
    """Plane of slope `e_per_pixel` towards `angle_deg` (from +x towards +y) on `level_e` [e- per frame]."""
    angle = np.deg2rad(effect.get("angle_deg", 0.0))
    y, x = (np.arange(size) - (size - 1) / 2 for size in window)
    plane = np.cos(angle) * x + np.sin(angle) * y[:, None]
    return effect.get("level_e", 0.0) + effect.get("e_per_pixel", 0.0) * plane


def marked(pixels: Iterable[tuple[int, int]], window: tuple[int, int]) -> np.ndarray:
    """True at the listed pixels (row, column), (rows, columns)."""
    mask = np.zeros(window, dtype=bool)
    for row, column in pixels:
        mask[row, column] = True
    return mask
