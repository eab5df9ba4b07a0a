"""A side-car to be filled in: every key with what it means, and what the header of the file says.

Keywords of common use say it by the convention of their authors.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from astropy.io import fits

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.fitsfile import file_header, header_number, open_fits, stem
from irlos_pipe.readers.sidecar import FOLDER_SIDECAR, KEYS, KNOWN, is_valid

HEADER, PROFILE = "the header", "the instrument profile"
HEAD = """\
# How {name} was taken. Three keys have no default: fill them in. A key behind a # keeps the
# value of the header or of the instrument profile, if they give one; remove the # to set another. A value of
# a keyword is only a proposal: compare its meaning and its unit.
"""
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
    for key, known in KNOWN.items():
        name = next((one for one in known.keywords if is_valid(key, header.get(one))), None)
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
    found = (
        (name, header_number(header, name)) for name in names if is_valid("exposure_s", header.get(name))
    )
    return next(found, ("", None))


def sidecar_template(path: Path, instrument: Instrument, stated: str = "") -> str:
    """Return a commented side-car for the recording at `path`; the `instrument` has defaults.

    The side-car states it under the name, or the path from there, that is `stated`.

    Raises `InputDataError` when there is no recording in the file.
    """
    recordings = read_recordings(path, instrument)
    first = recordings[0]
    with open_fits(path, verify=False) as hdus:
        candidates = proposals(file_header(hdus), first.frames)
    candidates |= {key: Proposal(value, PROFILE) for key, value in first.of_mode.items()}
    candidates |= {key: Proposal(value, HEADER) for key, value in first.header.items()}
    candidates["instrument"] = Proposal(stated or "irlos", "--instrument" if stated else PROFILE)
    lines = _lines(candidates, instrument.defaults)
    remarks = "".join(f"# {line}\n" for line in first.warnings)
    return HEAD.format(name=path.name) + remarks + "\n".join(lines) + "\n"


def write_template(text: str, data_file: Path, path: Path | None = None, *, replace: bool = False) -> Path:
    """Write `text` as the side-car of the recording `data_file`, and return where it is.

    That is `path`, by default ``<stem>.yaml`` next to the recording, or ``acquisition.yaml`` where the folder
    has the recording's name. A file that is there is only replaced with `replace`.

    Raises `ConfigurationError` when there is a file that is not to be replaced.
    """
    if path is None:
        in_folder = data_file.absolute().parent.name == stem(data_file)
        path = data_file.with_name(FOLDER_SIDECAR if in_folder else f"{stem(data_file)}.yaml")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists; give another --output, or --force to replace it")
    write_bytes(path, text.encode())
    return path


def _lines(candidates: Mapping[str, Proposal], assumed: Mapping[str, Any]) -> list[str]:
    lines = {key: _line(key, candidates, assumed) for key in KEYS}
    inner = [line for key, line in lines.items() if "." in key]
    proposed = any(not line.startswith("#") for line in inner)
    own = [line for key, line in lines.items() if "." not in key]
    own.insert(0, own.pop())  # the instrument
    return [*own, "detector:" if proposed else "# detector:", *inner]


def _line(key: str, candidates: Mapping[str, Proposal], assumed: Mapping[str, Any]) -> str:
    if KNOWN[key].form:
        return f"{key}:  # {KNOWN[key].form}"
    one = candidates.get(key, Proposal(assumed.get(key), PROFILE))
    origin = "" if one.value is None else f"; from {one.source}" + (f". {one.doubt}" if one.doubt else "")
    mark = "# " if one.value is None or one.doubt or one.source in (HEADER, PROFILE) else ""
    indent = "  " if "." in key else ""
    meaning = KEYS[key].description
    return f"{mark}{indent}{key.rpartition('.')[2]}:{_written(one.value)}  # {meaning}{origin}"


def _written(value: Any) -> str:
    if value is None:
        return ""
    return " " + yaml.safe_dump(value, default_flow_style=True, allow_unicode=True).splitlines()[0]
