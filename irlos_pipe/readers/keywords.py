"""What keywords of common use say of a recording, by the convention of their authors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from astropy.io import fits

from irlos_pipe.readers.fitsfile import header_number
from irlos_pipe.readers.sidecar import AcquisitionKeys

KEYWORDS = {
    "target": ("OBJECT", "TARGNAME"),
    "exposure_s": ("EXPTIME",),
    "seeing_arcsec": ("ESO TEL AMBI FWHM START", "SEEING"),
    "mag_j": ("ESO SEQ NGS MAG",),
    "derotator_angle_deg": ("ESO INS DROT START",),
    "parallactic_angle_deg": ("PARANG", "ESO TEL PARANG START"),
    "altitude_deg": ("EL", "ESO TEL ALT"),
    "airmass": ("AIRMASS",),
    "filter": ("FILTER",),
    "detector.e_per_adu": ("EGAIN", "ESO DET OUT1 CONAD", "GAIN"),
    "detector.read_noise_e": ("RDNOISE", "READNOIS", "ESO DET OUT1 RON"),
    "detector.coadds": ("COADDS", "COADDONE", "CO_ADDS", "NCOADDS"),
}
READ_TIMES = ("TRUITIME", "ITIME", "COADDEXP")  # of one coadd, as Keck, IRTF and Gemini write it [s]
ESO_DIT, ESO_NDIT = ("ESO DET SEQ1 DIT", "ESO DET DIT"), "ESO DET NDIT"
ELECTRONS_PER_COUNT = re.compile(r"\be(lectrons?|l)?-?s?\s*(/|per)\s*(adu|dn|count)", re.IGNORECASE)
GAIN_DOUBT = "GAIN may be e-/ADU, ADU/e- or a setting of the camera: remove the # only in the first case"
NDIT_DOUBT = (
    "a frame of ESO is the mean of NDIT exposures, or one of them; if their mean, set coadds_averaged too"
)


@dataclass(frozen=True)
class Proposal:
    """A value for a key of the side-car, the keywords it is from, and what makes it doubtful."""

    value: Any
    source: str
    doubt: str = ""


def proposals(header: fits.Header, planes: int) -> dict[str, Proposal]:
    """Return what the `header` of a recording of so many `planes` says, by side-car key."""
    found = {}
    for key, names in KEYWORDS.items():
        name = next((one for one in names if _valid(key, header.get(one))), None)
        if name is not None:
            sure = name != "GAIN" or ELECTRONS_PER_COUNT.search(header.comments[name])
            found[key] = Proposal(header[name], name, "" if sure else GAIN_DOUBT)
    if "altitude_deg" in found:
        # one of the two says it; of different moments they would contradict each other
        found.pop("airmass", None)
    return found | (_of_coadds(header, found) or _of_ndit(header, planes))


def _of_coadds(header: fits.Header, found: dict[str, Proposal]) -> dict[str, Proposal]:
    """Keck's convention: the time is that of one coadd, and an exposure is their sum."""
    name, read_s = _first(header, READ_TIMES)
    if read_s is None:
        return {}
    coadds = found.get("detector.coadds")
    if coadds is None:
        return {"exposure_s": Proposal(read_s, name)}
    return {
        "exposure_s": Proposal(read_s * coadds.value, f"{name} x {coadds.source}"),
        "detector.read_s": Proposal(read_s, name),
    }


def _of_ndit(header: fits.Header, planes: int) -> dict[str, Proposal]:
    """ESO's convention: a cube has NDIT exposures of DIT, and may end with their mean."""
    name, dit_s = _first(header, ESO_DIT)
    ndit = header_number(header, ESO_NDIT)
    if dit_s is None or ndit is None or ndit <= 1 or planes in (ndit, ndit + 1):
        return {} if dit_s is None else {"exposure_s": Proposal(dit_s, name)}
    return {
        "exposure_s": Proposal(dit_s * ndit, f"{name} x {ESO_NDIT}", NDIT_DOUBT),
        "detector.coadds": Proposal(int(ndit), ESO_NDIT, NDIT_DOUBT),
    }


def _first(header: fits.Header, names: tuple[str, ...]) -> tuple[str, float | None]:
    found = ((name, header_number(header, name)) for name in names if _valid("exposure_s", header.get(name)))
    return next(found, ("", None))


def _valid(key: str, value: Any) -> bool:
    """Whether a value of the header is one that the key can have."""
    section, _, inner = key.rpartition(".")
    try:
        AcquisitionKeys.model_validate({section: {inner: value}} if section else {key: value})
    except ValueError:
        return False
    return value is not None and value != ""
