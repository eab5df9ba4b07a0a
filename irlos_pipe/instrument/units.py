"""Units of facts: which one a name asks for, and the ways in which people write it."""

from __future__ import annotations

import re

# What the end of a name says; a longer one comes first.
ENDINGS = {
    "nm_per_arcsec": "nm/arcsec",
    "mag_per_arcsec2": "mag/arcsec2",
    "e_per_adu": "e-/ADU",
    "e_per_s": "e-/s",
    "per_m": "1/m",
    "per_s": "1/s",
    "arcsec": "arcsec",
    "percent": "%",
    "hpa": "hPa",
    "adu": "ADU",
    "mas": "mas",
    "deg": "deg",
    "nm": "nm",
    "hz": "Hz",
    "m": "m",
    "s": "s",
    "e": "e-",
}
OTHER_KEYS = {"temperature_c": "C", "detector.excess_noise_factor": "1"}  # of the side-car
SYNONYMS = {
    "1": ("", "-", "none", "dimensionless", "number", "cycles", "frames", "photons", "photon", "ph"),
    "1/s": ("hz", "s-1", "s^-1", "fps"),
    "1/m": ("m-1", "m^-1"),
    "m": ("metre", "metres", "meter", "meters"),
    "nm": ("nanometre", "nanometres", "nanometer", "nanometers"),
    "mas": ("milliarcsec", "milliarcsecond", "milliarcseconds"),
    "arcsec": ("arcsecond", "arcseconds", '"', "″"),
    "s": ("sec", "second", "seconds"),
    "deg": ("degree", "degrees", "°"),
    "e-": ("e", "e⁻", "electron", "electrons"),
    "adu": ("dn", "count", "counts"),
    "hpa": ("mbar",),
    "c": ("°c", "degc", "celsius"),
    "%": ("percent",),
    "arcsec2": ("arcsec^2", "arcsec²"),
}  # fmt: skip
PLAIN = {spelling: unit for unit, spellings in SYNONYMS.items() for spelling in spellings}
PER_PIXEL = ("px", "pix", "pixel")


def unit_of_name(name: str) -> str | None:
    """Return the unit that a fact or a key of the side-car carries in its `name`; None without one."""
    if name in OTHER_KEYS:
        return OTHER_KEYS[name]
    key = name.rpartition(".")[2]
    return next((unit for end, unit in ENDINGS.items() if key == end or key.endswith(f"_{end}")), None)


def require_unit(name: str, unit: str, wanted: str) -> None:
    """Check the `unit` of the fact `name` against the one that is `wanted`.

    Values are not converted: which of the two is the mistake, only the author of the profile knows. Of a unit
    for several columns (``Hz, 1, 1``) the first counts.

    Raises
    ------
    ValueError
        Naming both.
    """
    if _plain(unit) != _plain(wanted):
        raise ValueError(
            f"fact '{name}' should be in {wanted}, but its unit is '{unit}'; "
            "convert the value, or correct the unit"
        )


def _plain(unit: str) -> str:
    """The unit in one spelling."""
    first = re.split(r",|\band\b", unit.lower())[0]
    text = re.sub(r"\s+per\s+", "/", f" {first} ").replace(" ", "").removesuffix("rms")
    parts = [PLAIN.get(part, part) for part in PLAIN.get(text, text).split("/") if part not in PER_PIXEL]
    return "/".join(parts)
