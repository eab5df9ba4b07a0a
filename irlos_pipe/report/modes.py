"""Names of Zernike modes as AO engineers say them."""

from __future__ import annotations

from irlos_pipe.optics.zernike import noll_to_nm

FAMILIES = {
    0: "spherical",
    1: "coma",
    2: "astigmatism",
    3: "trefoil",
    4: "quadrafoil",
    5: "pentafoil",
    6: "hexafoil",
}
LOW_ORDER = {1: "piston", 2: "tilt x", 3: "tilt y", 4: "defocus"}
# Modes of an azimuthal order that have names of their own, before the family begins.
NAMED_APART = {0: 2, 1: 1}
ORDINALS = ("", "2nd ", "3rd ", "4th ", "5th ", "6th ")


def mode_name(noll: int) -> str:
    """Return the name of a mode: ``coma x``, ``2nd astigmatism 45°``.

    Odd azimuthal orders end in the axis they lie along, even ones in the angle of their first
    maximum from +x.
    """
    if noll in LOW_ORDER:
        return LOW_ORDER[noll]
    n, m = noll_to_nm(noll)
    family = FAMILIES.get(abs(m), f"{abs(m)}-foil")
    order = (n - abs(m)) // 2 - NAMED_APART.get(abs(m), 0)
    return f"{ORDINALS[order] if order < len(ORDINALS) else f'{order + 1}th '}{family}{_direction(m)}"


def label(noll: int) -> str:
    """Return Noll index and name: ``4 defocus``."""
    return f"{noll} {mode_name(noll)}"


def _direction(m: int) -> str:
    if m == 0:
        return ""
    if m % 2:
        return " x" if m > 0 else " y"
    return " 0°" if m > 0 else f" {90 / -m:g}°"
