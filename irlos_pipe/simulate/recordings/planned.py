"""A recording to be made. Worker processes need no more of a spec than this, and load no model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from irlos_pipe.simulate.scene import Scene

LOOP_HZ = 200
BYTES_PER_VALUE, BYTES_PER_SUM = 2, 4  # of a read, and of a sum of reads
DOUBLE = "__"  # stands for '/' in the names of truth files
Defocus = float | tuple[float, ...]  # of all frames, or of every frame [nm RMS]


@dataclass(frozen=True)
class Planned:
    """A recording to be made.

    Attributes
    ----------
    name : str
        ``calibration``, or ``ramp/offset_03`` in a series.
    scene : Scene
        What happens; the defocus is what the focus stage reaches.
    commanded_nm : float or tuple of float
        Introduced defocus as commanded, which the side-car states [nm RMS].
    hidden : mapping
        Effects that the side-car does not state, those of the focus stage included.
    layout, mode : str
        Of the files; mode string of a MUSE file.
    side_car : bool
        Whether one is written; a MUSE file may do without.
    """

    name: str
    scene: Scene
    commanded_nm: Defocus
    hidden: Mapping[str, Mapping[str, Any]]
    layout: str
    mode: str
    side_car: bool = True

    @property
    def size_bytes(self) -> int:
        """Size of its frames on the disk."""
        rows, columns = self.scene.window
        each = BYTES_PER_VALUE if self.scene.reads == 1 else BYTES_PER_SUM
        return self.scene.frames * rows * columns * each
