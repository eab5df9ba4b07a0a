"""What is known of a recording before it is reduced: enough to assign it to a night and a group."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import takewhile
from pathlib import Path

# A night is named after its evening. It ends at local noon of Paranal (70.4 degrees west).
NOON_UTC = timedelta(hours=12 + 70.4 / 15)


@dataclass(frozen=True)
class Description:
    """One recording.

    Attributes
    ----------
    path : Path
        The recorder's folder, or the file: the input that a recipe is given.
    night : str
        Date of its evening, ISO.
    start_unix_s : float or None
        Start time since 1970 [s]; None where the recording does not state it.
    mode : str
        Read-out mode, empty where the file layout has none.
    configuration : str
        What the NCPAs depend on: read-out mode, pixel scale, diversity. Recordings with equal text
        were taken through the same optics.
    spectrum : str
        Wavelengths and weights.
    window : tuple of int
        Rows and columns [px].
    full_pupil : bool
        False for the images of a 2x2 mode.
    content : str
        Checksum of the frames, the same for a copy.
    night_by : str
        What the night was taken from where the recording states no time; else empty.
    """

    path: Path
    name: str
    role: str
    night: str
    start_unix_s: float | None = None
    mode: str = ""
    configuration: str = ""
    spectrum: str = ""
    window: tuple[int, int] = (0, 0)
    frames: int = 0
    target: str = ""
    exposure_s: float | None = None
    derotator_angle_deg: float = 0.0
    full_pupil: bool = True
    content: str = ""
    night_by: str = ""

    def same_frames(self, other: Description) -> bool:
        """Whether `other` holds the same frames, taken at the same time as far as that is known."""
        if not self.content or (self.content, self.mode) != (other.content, other.mode):
            return False
        known = self.start_unix_s is not None and other.start_unix_s is not None
        return not known or abs((self.start_unix_s or 0.0) - (other.start_unix_s or 0.0)) < 1.0

    def same_description(self, other: Description) -> bool:
        """Whether `other` is said to be the same."""
        names = ("role", "configuration", "spectrum", "target", "exposure_s", "derotator_angle_deg")
        return all(getattr(self, name) == getattr(other, name) for name in names)


def night_of(unix_s: float) -> str:
    """Return the night of a time [s since 1970], as the ISO date of its evening."""
    return (datetime.fromtimestamp(unix_s, UTC) - NOON_UTC).date().isoformat()


def utc_time(unix_s: float | None, pattern: str = "%H:%M:%S") -> str:
    """Format the time of day of `unix_s` with a strftime `pattern`; return "" if it is not known."""
    return "" if unix_s is None else datetime.fromtimestamp(unix_s, UTC).strftime(pattern)


def common_depth(path: Path, other: Path) -> int:
    """Return how many leading folders `path` and `other` have in common."""
    pairs = zip(path.parts, other.parts, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
