"""What the keywords of an ESO header say of a recording, whatever its layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from astropy.io import fits

from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.fitsfile import header_number

HEADER_KEYS = {
    "mag_j": "ESO SEQ NGS MAG",
    "seeing_arcsec": "ESO TEL AMBI FWHM START",
    "parallactic_angle_deg": "ESO TEL PARANG START",
    "altitude_deg": "ESO TEL ALT",
    "airmass": "ESO TEL AIRM START",
    "pressure_hpa": "ESO TEL AMBI PRES START",
    "temperature_c": "ESO TEL AMBI TEMP",
    "humidity_percent": "ESO TEL AMBI RHUM",
    "derotator_angle_deg": "ESO INS DROT START",
}
MONITOR = "mass_dimm"  # whose seeing stands in the header


def header_keys(header: fits.Header) -> dict[str, Any]:
    """Return side-car keys with the finite numbers that an ESO `header` has, and whose seeing it is."""
    numbers = {key: header_number(header, name) for key, name in HEADER_KEYS.items()}
    found: dict[str, Any] = {key: value for key, value in numbers.items() if value is not None}
    return found | ({"seeing_scale": MONITOR} if "seeing_arcsec" in found else {})


def plain_header_keys(
    path: Path, header: fits.Header, instrument: Instrument
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what `header_keys` finds in the primary header of a file of any instrument, and remarks.

    The seeing is left out where the profile of the `instrument` has no scale for its monitor: no recording
    should fail for what nobody told.

    Parameters
    ----------
    path : Path
        The file, for the remarks.
    header : Header
    instrument : Instrument

    Returns
    -------
    keys : dict
        As of `header_keys`.
    notes : tuple of str
        Remarks for the log.
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
