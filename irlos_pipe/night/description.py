"""What the night has to know of a recording to decide what becomes of it: a few plain values."""

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
        What a recipe is given: the recorder's folder, or the file.
    night : str
        Date of its evening, ISO.
    start_unix_s : float or None
        Begin since 1970 [s]; None where the recording does not tell.
    mode : str
        Read-out mode, empty where the layout has none.
    configuration : str
        What the NCPAs depend on, in words: read-out mode, pixel scale, diversity. Recordings of the
        same text were taken through the same optics.
    spectrum : str
        Wavelengths and weights in words.
    full_pupil : bool
        False for the images of a 2x2 mode.
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


def night_of(unix_s: float) -> str:
    """Return the night a moment belongs to, as the ISO date of its evening."""
    return (datetime.fromtimestamp(unix_s, UTC) - NOON_UTC).date().isoformat()


def clock(unix_s: float | None, pattern: str = "%H:%M:%S") -> str:
    """Return the UTC time of day; nothing when it is not known."""
    return "" if unix_s is None else datetime.fromtimestamp(unix_s, UTC).strftime(pattern)


def common_depth(one: Path, other: Path) -> int:
    """Return how many folders two paths have in common."""
    pairs = zip(one.parts, other.parts, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
