"""The correction in the modes of a mirror, whose table is a FITS cube of OPD maps."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.mirror_modes import MirrorOffsets, mirror_offsets
from irlos_pipe.files.first_image import first_image
from irlos_pipe.files.regular import open_regular
from irlos_pipe.optics.wavefront import clear_pupil
from irlos_pipe.product.header import Card
from irlos_pipe.product.product import declared
from irlos_pipe.product.results import DITTO, Number, ResultsPart, item
from irlos_pipe.product.table import Column, Table
from irlos_pipe.stages.base import StageContext, StageOutput

SIGN = (
    "offset: add it to the reference of the mode to cancel the aberration; in the unit of the table of "
    "modes, whose maps are OPD in nm; diversity, piston, tip and tilt not included"
)
ARRAYS = {"mirror_offset": ("±", "mode", SIGN)}
LEAST_SAMPLES, MOST_SAMPLES, MOST_MODES = 16, 512, 2000


class MirrorFile(BaseModel):
    """A file with modes, by its content: other modes in the same file are another correction."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    file: str = Field(description="path of the FITS cube")
    sha256: str = Field(description="checksum of its content, filled in when the recipe is read")


def mirror_file(value: Any) -> Any:
    """Return path and checksum for the path of a file; for both of before, those of the file as it is now.

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


class MirrorRow(ResultsPart):
    """The correction in the modes of a mirror, see `estimate.mirror_modes.MirrorOffsets`."""

    modes: int = item(0, "Number of modes of its table.")
    offset: list[Number] = item([], "Offset of each, in the unit of the table.")
    before_nm: Number = item(
        nan,
        "RMS over the clear pupil without piston, tip and tilt: of the estimated wavefront, and of what the "
        "modes cannot make of it [nm].",
    )
    after_nm: Number = item(nan, DITTO)


def in_mirror_modes(ctx: StageContext, output: StageOutput) -> StageOutput:
    """Return the output of the stage with the offsets of a mirror's modes, as arrays, results and files.

    Parameters
    ----------
    ctx : StageContext
        Its settings name the table of modes.
    output : StageOutput
        Without them.

    Raises
    ------
    InputDataError
        If the table cannot be used.
    """
    named: MirrorFile = ctx.config.mirror_modes
    path = Path(named.file)
    maps_nm = _read_modes(path)
    arrays = ctx.products["calibrate"].arrays
    nolls, zernike_nm, covariance_nm2 = (
        np.asarray(arrays[name].value) for name in ("noll", "zernike_nm", "covariance_nm2")
    )
    lit = clear_pupil(ctx.instrument.pupil, maps_nm.shape[-1])
    try:
        found = mirror_offsets(maps_nm, nolls.tolist(), zernike_nm, covariance_nm2, lit, ctx.config.gain)
    except ValueError as problem:
        raise InputDataError(f"{path}: {problem}") from None
    table = _table(named, ctx.config.gain, found)
    row = MirrorRow.filled_from(found, modes=len(found.value), offset=found.value.tolist())
    line = (
        f"  {len(found.value)} modes of {path.name}: {found.before_nm:.1f} nm RMS, of which they cannot make "
        f"{found.after_nm:.1f}; offsets in mirror.csv and mirror.fits"
    )
    return replace(
        output,
        arrays=output.arrays | declared(ARRAYS, {"mirror_offset": (found.value, found.sigma)}),
        results=output.results.model_copy(update={"mirror": row}),
        files=output.files | {"mirror.csv": table, "mirror.fits": table},
        summary=[*output.summary, line],
    )


def _table(named: MirrorFile, gain: float, found: MirrorOffsets) -> Table:
    columns = (
        Column("mode", "", np.arange(len(found.value)), "index in the table, from 0"),
        Column("offset", "", found.value, "to be added to the reference", ".6g"),
        Column("sigma", "", found.sigma, "1-sigma error", ".3g"),
    )
    facts = (
        Card("IRLOS SIGN", "offset cancels NCPA", "add it to the reference"),
        Card("IRLOS BASIS", Path(named.file).name, "table of modes"),
        Card("IRLOS BASIS SHA256", named.sha256[:32], "first 32 digits"),
        Card("IRLOS GAIN", gain, "part of the aberration corrected"),
        Card("ESO QC MIRROR BEFORE", found.before_nm, "[nm] RMS over the clear pupil"),
        Card("ESO QC MIRROR AFTER", found.after_nm, "[nm] RMS that the modes cannot make"),
    )
    return Table("MIRROR_OFFSETS", "IRLOS_MIRROR_OFFSETS", columns, SIGN, facts)


def _read_modes(path: Path) -> np.ndarray:
    """Return OPD maps of a mirror's modes, (modes, n, n), from the first image of a FITS file.

    n samples lie across the diameter of the pupil, as pixels across a window; row index is y.
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
