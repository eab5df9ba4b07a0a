"""Results of stage `correct`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import ByNoll, Number, StageResults


class CorrectResults(StageResults):
    """Offsets to add to the reference [nm RMS], and the Strehl ratio predicted without and with them."""

    stage: ClassVar[str] = "correct"
    offset_nm: ByNoll = {}
    sign: str = ""
    strehl_before: Number = math.nan
    strehl_after: Number = math.nan
