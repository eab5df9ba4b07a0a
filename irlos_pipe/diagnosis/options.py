"""What can be chosen of a diagnosis."""

from collections.abc import Mapping
from dataclasses import dataclass, field

DRIFT_NM = 10.0  # change of every mode from one star or night to another


@dataclass(frozen=True)
class Options:
    """Choices of a diagnosis."""

    # Noll 2 to this belong to every model; what lies beyond can be found as `high_order_ncpa`.
    highest_noll: int
    held_out: float  # part of the frames that no fit sees
    most_names: int  # at which to stop
    sure: float  # significance of a detection in Gaussian σ
    drift_nm: float = DRIFT_NM  # prior σ of the change of every mode between stars and nights [nm RMS]
    # Wavefront, of another recording, from which fits begin as well; Noll index to nm RMS.
    begin_near_nm: Mapping[int, float] = field(default_factory=dict)
