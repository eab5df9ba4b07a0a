"""Results of stage `prior`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class DefocusPrior(ResultsPart):
    """Prior of the defocus of one frame.

    Attributes
    ----------
    name : str
        Recording, in which the frame has the number `frame`.
    frame : int
        Number of the frame in its recording, from 0.
    introduced_nm : float
        Defocus introduced by the focus stage.
    defocus_nm : float
        Defocus by the law, from the widths of the image.
    """

    name: str = ""
    frame: int = 0
    introduced_nm: Number = math.nan
    defocus_nm: Number = math.nan


class PriorResults(StageResults):
    """The law defocus = `A` (σ1/σ2 − 1) + `B` [nm], and what it gives for every frame.

    Attributes
    ----------
    A, B : float
        Slope and constant of the law [nm]; σ1 and σ2 are the widths of the image along the two axes.
    angle_deg : float
        Direction of the first axis, from +x towards +y.
    valid_nm : (float, float)
        Range of defocus of the law.
    law_residual_nm : float
        RMS departure of the law from the model.
    """

    stage: ClassVar[str] = "prior"
    A: Number = math.nan
    B: Number = math.nan
    angle_deg: Number = math.nan
    valid_nm: tuple[Number, Number] = (math.nan, math.nan)
    law_residual_nm: Number = math.nan
    estimates: list[DefocusPrior] = []
