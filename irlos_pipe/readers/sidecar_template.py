"""A side-car to be filled in: every key with what it means, and what the header of the file says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.fitsfile import file_header, open_fits, stem
from irlos_pipe.readers.keywords import Proposal, proposals
from irlos_pipe.readers.sidecar import FOLDER_SIDECAR, AcquisitionKeys, DetectorKeys

FORMS = {
    "role": "ncpa_calibration, defocus_ramp, derotator, psf or dark",
    "spectrum": "[{wavelength_nm: 1600, weight: 1.0}], any number of points",
    "diversity": "{source: lens, zernike: {6: -170.0}}, Noll: nm RMS; zernike: {} without one",
}
REQUIRED = tuple(FORMS)
HEADER, PROFILE = "the header", "the instrument profile"
HEAD = """\
# How {name} was taken. Three keys have no default: fill them in. A key behind a # keeps the
# value of the header or of the instrument profile, if they give one; remove the # to set another. A value of
# a keyword is only a proposal: compare its meaning and its unit.
"""


def sidecar_template(path: Path, instrument: Instrument) -> str:
    """Return a commented side-car for the FITS file at `path`.

    Parameters
    ----------
    path : Path
        A recording of any layout.
    instrument : Instrument
        Knows the read-out modes, and what is assumed of keys that are not given.

    Raises
    ------
    InputDataError
        When there is no recording in the file.
    """
    recordings = read_recordings(path, instrument)
    first = recordings[0]
    with open_fits(path, verify=False) as hdus:
        told = proposals(file_header(hdus), first.frames)
    told |= {key: Proposal(value, PROFILE) for key, value in first.of_mode.items()}
    told |= {key: Proposal(value, HEADER) for key, value in first.header.items()}
    lines = _lines(AcquisitionKeys, "", told, instrument.defaults)
    remarks = "".join(f"# {line}\n" for line in first.warnings)
    return HEAD.format(name=path.name) + remarks + "\n".join(lines) + "\n"


def write_template(text: str, data_file: Path, path: Path | None = None, *, replace: bool = False) -> Path:
    """Write a side-car for a recording.

    Parameters
    ----------
    text : str
        The side-car.
    data_file : Path
        The recording.
    path : Path, optional
        The file to write; by default ``<stem>.yaml`` beside the recording, or ``acquisition.yaml`` where the
        folder has the recording's name.
    replace : bool
        Whether to replace a file.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ConfigurationError
        When there is a file that is not to be replaced.
    """
    if path is None:
        in_folder = data_file.absolute().parent.name == stem(data_file)
        path = data_file.with_name(FOLDER_SIDECAR if in_folder else f"{stem(data_file)}.yaml")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists; give another --output, or --force to replace it")
    write_bytes(path, text.encode())
    return path


def _lines(
    model: type[BaseModel], above: str, told: Mapping[str, Proposal], assumed: Mapping[str, Any]
) -> list[str]:
    lines = []
    for key, field in model.model_fields.items():
        name = f"{above}{key}"
        if name == "detector":
            inner = _lines(DetectorKeys, "detector.", told, assumed)
            proposed = any(not line.startswith("#") for line in inner)
            lines += ["detector:" if proposed else "# detector:", *inner]
        else:
            lines.append(_line(name, field.description or "", told, assumed))
    return lines


def _line(name: str, meaning: str, told: Mapping[str, Proposal], assumed: Mapping[str, Any]) -> str:
    if name in REQUIRED:
        return f"{name}:  # {FORMS[name]}"
    one = told.get(name, Proposal(assumed.get(name), PROFILE))
    origin = "" if one.value is None else f"; from {one.source}" + (f". {one.doubt}" if one.doubt else "")
    mark = "# " if one.value is None or one.doubt or one.source in (HEADER, PROFILE) else ""
    indent = "  " if "." in name else ""
    return f"{mark}{indent}{name.rpartition('.')[2]}:{_written(one.value)}  # {meaning}{origin}"


def _written(value: Any) -> str:
    if value is None:
        return ""
    return " " + yaml.safe_dump(value, default_flow_style=True, allow_unicode=True).splitlines()[0]
