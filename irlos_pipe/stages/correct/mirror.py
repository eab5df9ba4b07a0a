"""The correction in the modes of a mirror, beside that in Zernike polynomials."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.mirror_modes import MirrorOffsets, mirror_offsets
from irlos_pipe.optics.wavefront import clear_pupil
from irlos_pipe.product.header import Card
from irlos_pipe.product.product import declared
from irlos_pipe.product.results import DITTO, Number, ResultsPart, item
from irlos_pipe.product.table import Column, Table
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.correct.mirror_file import MirrorFile, read_modes

SIGN = (
    "offset: add it to the reference of the mode to cancel the aberration; in the unit of the table of "
    "modes, whose maps are OPD in nm; diversity, piston, tip and tilt not included"
)
ARRAYS = {"mirror_offset": ("±", "mode", SIGN)}


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
    maps_nm = read_modes(path)
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
    row = MirrorRow(
        modes=len(found.value),
        offset=found.value.tolist(),
        before_nm=found.before_nm,
        after_nm=found.after_nm,
    )
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
