"""A recording as it stands in its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.frames.raw import RawFrames


@dataclass(frozen=True, kw_only=True)
class RawRecording(RawFrames):
    """One recording as read from its files.

    Attributes
    ----------
    name : str
        Name of the recording, from its file.
    path : Path
        The file with the frames.
    layout : str
        ``sparta_recorder``, ``muse_raw``, ``fits_cube`` or ``aot``.
    unix_s : ndarray of float, (frames,), or None
        Time of each frame, NaN where it is not known [s since 1970]; None when no frame has one.
    header : mapping
        Side-car keys (``detector.`` ones dotted) that the file itself knows.
    mode : str
        Read-out mode string, empty where the layout has none.
    of_mode : mapping
        Side-car keys that the instrument profile states of that mode.
    start_unix_s : float
        Begin of the recording, NaN if not known [s since 1970].
    notes : tuple of str
        Remarks for the log.
    warnings : tuple of str
        Remarks that people should see.
    cards : mapping
        What products inherit of the file's primary header, by keyword.
    """

    name: str
    path: Path
    layout: str
    unix_s: np.ndarray | None = None
    header: Mapping[str, Any] = field(default_factory=dict)
    mode: str = ""
    of_mode: Mapping[str, Any] = field(default_factory=dict)
    start_unix_s: float = float("nan")
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    cards: Mapping[str, Any] = field(default_factory=dict)
