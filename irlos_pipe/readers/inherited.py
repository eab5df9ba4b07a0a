"""Cards of a recording's header that its products inherit."""

from __future__ import annotations

import math
import re

from astropy.io import fits

from irlos_pipe.conventions.text import printable

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
MAX_CARDS = 100  # a header may say the same many times


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
