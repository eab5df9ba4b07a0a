"""A recording as it stands in its files, and what the keywords of a header say of it, whatever its layout."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.text import printable
from irlos_pipe.frames.recording import RawFrames
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.fitsfile import header_number
from irlos_pipe.readers.sidecar import KNOWN

MONITOR = "mass_dimm"  # seeing monitor of ESO's headers
# Cards that products inherit.
PLAIN = frozenset(
    (
        "ORIGIN", "TELESCOP", "INSTRUME", "OBJECT", "RA", "DEC", "EQUINOX", "RADESYS", "DATE-OBS", "MJD-OBS",
        "EXPTIME", "UTC", "LST", "PI-COI", "OBSERVER", "ARCFILE", "ORIGFILE",
    )
)  # fmt: skip
# Who observed what with which template, and where telescope and derotator stood.
GROUPS = re.compile(
    r"ESO (OBS (ID|NAME|PROG ID|TARG NAME)|TPL (ID|NAME|START)|DPR (CATG|TYPE|TECH)|INS (MODE|DROT [A-Z]+)|"
    r"TEL (ALT|AZ|AIRM [A-Z]+|PARANG [A-Z]+|AMBI [A-Z0-9 ]+)|SEQ NGS MAG|AOS MAIN MODES IRLOS)"
)
MAX_CARDS = 100  # that a product inherits: a header may repeat a card many times


@dataclass(frozen=True, kw_only=True)
class RawRecording(RawFrames):
    name: str  # of the recording, from its file
    path: Path  # the file with the frames
    layout: str  # ``sparta_recorder``, ``muse_raw``, ``fits_cube`` or ``aot``
    # time of each frame, (frames,), NaN where it is not known [s since 1970]; None when no frame has one
    unix_s: np.ndarray | None = None
    header: Mapping[str, Any] = field(default_factory=dict)  # dotted side-car keys that the file itself knows
    mode: str = ""  # of the read-out, empty where the layout has none
    of_mode: Mapping[str, Any] = field(default_factory=dict)  # side-car keys that the profile has of the mode
    start_unix_s: float = float("nan")  # begin of the recording, NaN if not known [s since 1970]
    notes: tuple[str, ...] = ()  # remarks for the log
    warnings: tuple[str, ...] = ()  # remarks that people should see
    cards: Mapping[str, Any] = field(default_factory=dict)  # what products inherit of the primary header


def header_keys(header: fits.Header) -> dict[str, Any]:
    """Return side-car keys with the finite numbers that an ESO `header` has, and whose seeing it is."""
    numbers = {key: header_number(header, known.eso) for key, known in KNOWN.items() if known.eso}
    found: dict[str, Any] = {key: value for key, value in numbers.items() if value is not None}
    return found | ({"seeing_scale": MONITOR} if "seeing_arcsec" in found else {})


def plain_header_keys(
    path: Path, header: fits.Header, instrument: Instrument
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what `header_keys` finds in the `header` of the file `path` of any instrument, and remarks.

    The seeing is left out where the profile of the `instrument` has no scale for its monitor: no recording
    should fail for what nobody declared.
    """
    found = header_keys(header)
    if "seeing_arcsec" not in found or MONITOR in instrument.seeing_scales:
        return found, ()
    note = (
        f"{path}: the seeing of the header, {found['seeing_arcsec']:g} arcsec, is not used: "
        f"the profile of {instrument.name} has no seeing scale '{MONITOR}'"
    )
    unused = ("seeing_arcsec", "seeing_scale")
    return {key: value for key, value in found.items() if key not in unused}, (note,)


def inherited_cards(header: fits.Header) -> dict[str, str | bool | int | float]:
    """Return keyword and value of what products inherit of the `header` of a recording."""
    found: dict[str, str | bool | int | float] = {}
    for card in header.cards:
        keyword, value = card.keyword, card.value
        if len(found) == MAX_CARDS:
            break
        if (keyword in PLAIN or GROUPS.fullmatch(keyword)) and _can_be_handed_on(value):
            found.setdefault(keyword, printable(value) if isinstance(value, str) else value)
    return found


def _can_be_handed_on(value: object) -> bool:
    if isinstance(value, str):
        return bool(value.strip())
    return isinstance(value, (bool, int)) or (isinstance(value, float) and math.isfinite(value))
