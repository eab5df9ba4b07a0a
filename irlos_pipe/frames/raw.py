"""Frames as a recorder left them: counts, counters, calibration images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CalibrationMaps:
    """Calibration images that came with a recording, each (rows, columns) or None.

    Attributes
    ----------
    dark_adu : ndarray
        Signal without light [ADU].
    dark_variance_adu2 : float
        Variance per pixel of `dark_adu` itself [ADU²].
    background_adu : ndarray
        Sky on top of the dark [ADU].
    flat : ndarray
        Response of each pixel; only its ratio to the median matters.
    bad : ndarray of bool
        True for pixels declared dead or without weight.
    """

    dark_adu: np.ndarray | None = None
    dark_variance_adu2: float = 0.0
    background_adu: np.ndarray | None = None
    flat: np.ndarray | None = None
    bad: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class RawFrames:
    """Counts of one recording, and the calibration images that came with it.

    Attributes
    ----------
    adu : ndarray, (frames, rows, columns)
        Counts in the type they were recorded in.
    frame_counter : ndarray of int, (frames,)
        Counter of the recorder.
    calibration : CalibrationMaps
    lenslets : int
        Per side of the pupil; with 2 the window is that of four images side by side.
    """

    adu: np.ndarray
    frame_counter: np.ndarray
    calibration: CalibrationMaps = CalibrationMaps()
    lenslets: int = 1

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.adu.shape[0]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns [px]."""
        _, rows, columns = self.adu.shape
        return rows, columns
