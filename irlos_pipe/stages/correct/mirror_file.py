"""The table of a mirror's modes: a FITS cube of OPD maps."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.fits import first_image
from irlos_pipe.files.regular import open_regular

LEAST_SAMPLES, MOST_SAMPLES, MOST_MODES = 16, 512, 2000


class MirrorFile(BaseModel):
    """A file with modes, by its content: other modes in the same file are another correction."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    file: str = Field(description="path of the FITS cube")
    sha256: str = Field(description="checksum of its content, filled in when the recipe is read")


def mirror_file(value: Any) -> Any:
    """Return path and checksum for the path of a file; for both of before, those of the file as it is now.

    Parameters
    ----------
    value : str, mapping or None

    Raises
    ------
    ValueError
        Where the file cannot be read.
    """
    named = value.get("file") if isinstance(value, dict) else value
    if not isinstance(named, str):
        return value
    path = Path(named).absolute()
    try:
        with open_regular(path) as stream:
            return {"file": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}
    except OSError as error:
        raise ValueError(f"{named}: {error.strerror or error}; give a FITS cube of OPD maps [nm]") from None


def read_modes(path: Path) -> np.ndarray:
    """Return OPD maps of a mirror's modes, (modes, n, n), from the first image of a FITS file.

    n samples lie across the diameter of the pupil, as pixels across a window; row index is y.

    Raises
    ------
    InputDataError
        If it is none, or its shape is not that.
    """
    try:
        maps, _ = first_image(path)
    except ValueError as error:
        raise InputDataError(f"{path}: {error}; modes are a cube of n × n maps across the pupil") from None
    if maps.ndim != 3 or maps.shape[1] != maps.shape[2]:
        found = " × ".join(map(str, maps.shape))
        raise InputDataError(f"{path}: an image of {found}; modes are a cube of n × n maps across the pupil")
    count, samples = maps.shape[:2]
    if not (LEAST_SAMPLES <= samples <= MOST_SAMPLES and 1 <= count <= MOST_MODES):
        raise InputDataError(
            f"{path}: {count} modes of {samples} × {samples}; up to {MOST_MODES} modes of {LEAST_SAMPLES} "
            f"to {MOST_SAMPLES} samples across can be used"
        )
    return maps
