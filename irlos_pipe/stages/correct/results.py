"""Results of stage `correct`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import ByNoll, Number, ResultsPart, StageResults


class StrehlRow(ResultsPart):
    """What one part of the model does to the Strehl ratio, see `estimate.strehl_budget.StrehlPart`.

    Attributes
    ----------
    name : str
        Part of the model: all of it, its modes, or an effect.
    wfe_nm : float
        RMS of its modes; NaN of an effect.
    alone, without : float
        Strehl ratio with nothing else in the model, and with all else but this part.
    """

    name: str = ""
    wfe_nm: Number = math.nan
    alone: Number = math.nan
    without: Number = math.nan


class MapRow(ResultsPart):
    """RMS about the mean, and peak to valley, of a map of the wavefront over the clear pupil [nm].

    Attributes
    ----------
    rms_nm : float
        RMS about the mean over the clear pupil.
    pv_nm : float
        Peak to valley over the clear pupil.
    """

    rms_nm: Number = math.nan
    pv_nm: Number = math.nan


class MirrorRow(ResultsPart):
    """The correction in the modes of a mirror, see `estimate.mirror_modes.MirrorOffsets`.

    Attributes
    ----------
    modes : int
        Number of modes of its table.
    offset : list of float
        Offset of each, in the unit of the table.
    before_nm, after_nm : float
        RMS over the clear pupil without piston, tip and tilt: of the estimated wavefront, and of what
        the modes cannot make of it [nm].
    """

    modes: int = 0
    offset: list[Number] = []
    before_nm: Number = math.nan
    after_nm: Number = math.nan


class CorrectResults(StageResults):
    """Offsets to add to the reference [nm RMS], and the Strehl ratio predicted without and with them.

    Attributes
    ----------
    offset_nm : dict of int to float
        Modal offsets to add to the reference, by Noll index [nm RMS]: −NCPA, without the diversity.
    sign : str
        What the sign of the offsets means, in words.
    strehl_before, strehl_after : float
        Strehl ratio predicted without and with the offsets.
    strehl_budget : list of StrehlRow
        What each part of the model costs the image before the correction; the whole model first.
    wavefront_before, wavefront_after : MapRow
        RMS and peak to valley of the maps of the wavefront, without tip and tilt.
    resolution_mas : float
        λ/D at the mean wavelength.
    mirror : MirrorRow or None
        The same correction in the modes of a mirror, where their table was given.
    """

    stage: ClassVar[str] = "correct"
    offset_nm: ByNoll = {}
    sign: str = ""
    strehl_before: Number = math.nan
    strehl_after: Number = math.nan
    strehl_budget: list[StrehlRow] = []
    wavefront_before: MapRow = MapRow()
    wavefront_after: MapRow = MapRow()
    resolution_mas: Number = math.nan
    mirror: MirrorRow | None = None
