"""Results of the experiment `mode_statistics`."""

from __future__ import annotations

from typing import ClassVar

from irlos_pipe.product.results import Number, StageResults
from irlos_pipe.stages.modes import LawRow


class ModeStatisticsResults(StageResults):
    """Standard deviation per mode; keys are methods, and ``introduced`` for the truth.

    Attributes
    ----------
    laws, laws_of_introduced_modes : dict of str to LawRow
        Fitted to all modes from Noll 4 on, and to those that were introduced.
    beyond_nm : dict of str to float
        RMS per mode beyond the introduced ones [nm].
    error_nm : dict of str to list of float
        RMS error of every cube beyond tip and tilt [nm].
    """

    stage: ClassVar[str] = "mode_statistics"
    cubes: int = 0
    modes_introduced: int = 0
    modes_estimated: int = 0
    laws: dict[str, LawRow] = {}
    laws_of_introduced_modes: dict[str, LawRow] = {}
    beyond_nm: dict[str, Number] = {}
    error_nm: dict[str, list[Number]] = {}
