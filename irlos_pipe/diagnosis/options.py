"""What can be chosen of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

DRIFT_NM = 10.0  # by which every mode may change from one star or night to another


@dataclass(frozen=True)
class Options:
    """Choices of a diagnosis.

    Attributes
    ----------
    highest_noll : int
        Noll 2 to this belong to every model; what lies beyond can be found as `high_order_ncpa`.
    held_out : float
        Part of the frames that no fit sees.
    most_names : int
        At which to stop.
    sure : float
        Significance of a detection in Gaussian σ.
    drift_nm : float
        Prior σ of the change of every mode between stars and nights [nm RMS].
    begin_near_nm : mapping of int to float
        Wavefront, of another recording, from which fits begin as well; Noll index to nm RMS.
    """

    highest_noll: int
    held_out: float
    most_names: int
    sure: float
    drift_nm: float = DRIFT_NM
    begin_near_nm: Mapping[int, float] = field(default_factory=dict)
