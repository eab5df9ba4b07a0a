"""A recording as it stands in its files: counts, counters, times, calibration images."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True)
class RawRecording:
    """One recording as read from its files.

    Attributes
    ----------
    layout : str
        ``sparta_recorder``, ``muse_raw``, ``fits_cube`` or ``aot``.
    adu : ndarray, (frames, rows, columns)
        Counts in the type they were recorded in.
    frame_counter : ndarray of int, (frames,)
    unix_s : ndarray of float, (frames,), or None
        Time of each frame, NaN where it is not known [s since 1970]; None when no frame has one.
    header : dict
        Side-car keys (``detector.`` ones dotted) that the file itself knows.
    mode : str
        Read-out mode string, empty where the layout has none.
    subaperture : int or None
        Number of the lenslet, from 1, row by row from the lowest; None in full-pupil modes.
    start_unix_s : float
        Begin of the recording, NaN if not known [s since 1970].
    notes : tuple of str
        Remarks for the log.
    """

    name: str
    path: Path
    layout: str
    adu: np.ndarray
    frame_counter: np.ndarray
    unix_s: np.ndarray | None = None
    header: dict[str, Any] = field(default_factory=dict)
    calibration: CalibrationMaps = CalibrationMaps()
    mode: str = ""
    subaperture: int | None = None
    start_unix_s: float = float("nan")
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.adu.shape[0]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns [px]."""
        return self.adu.shape[1:]
