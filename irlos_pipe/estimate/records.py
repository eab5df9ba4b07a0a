"""Parts of estimates that results.json holds as they are: every key is a field, described here only."""

from dataclasses import dataclass
from math import nan

from irlos_pipe.conventions.keys import DITTO, Number
from irlos_pipe.conventions.keys import key as item

DECISIVE = 10.0  # evidence from which a sign counts as known: odds of 150 to 1


@dataclass(frozen=True)
class TwinCheck:
    """Comparison with the twin solution, see `estimate.starts`."""

    delta_chi2: Number = item(nan, "χ² of the refitted twin minus that of the solution, prior included.")
    rms_nm: Number = item(
        nan, "RMS of the coefficients of the solution and of the twin, without tip and tilt."
    )
    twin_rms_nm: Number = item(nan, DITTO)
    distance_nm: Number = item(
        nan, "RMS difference between the two; near 0 where the twin fell back into the solution."
    )
    # The prior of the fit is wider than the law, so that it does not bend the estimates; it would understate
    # what the law says of a twin, which needs twice the diversity as an aberration.
    evidence: Number = item(
        nan,
        "-2 times the logarithm of the odds of the twin, by the data and the law of NCPAs; large: excluded.",
    )
    preferred: str = item("", "``solution``, ``twin``, or ``undecided`` where neither data nor law tell.")

    def __post_init__(self) -> None:
        preferred = "twin" if self.evidence < -DECISIVE else "undecided"
        if self.distance_nm < 1.0 or self.evidence > DECISIVE:
            preferred = "solution"
        object.__setattr__(self, "preferred", preferred)


@dataclass(frozen=True)
class Cause:
    """A fact or effect that would explain why a check failed, see `estimate.causes`."""

    name: str = item("", "What it is: a short identifier, such as ``plate_scale`` or ``transposed``.")
    says: str = item("", "The whole sentence for a person, key included.")
    explains: Number = item(nan, "Part of the misfit that it explains, 0 to 1; NaN where it is no misfit.")
    value: Number = item(
        nan,
        "Value that the data want, its standard error and the declared value; NaN where none is a number.",
    )
    sigma: Number = item(nan, DITTO)
    declared: Number = item(nan, DITTO)
    unit: str = item("", "Unit of the three.")
    key: str = item("", "Key of the side-car or profile to change; empty where none is.")
    figure: str = item("", "Figure of the report to look at, by its name there, such as ``cal-residual``.")


@dataclass(frozen=True)
class StrehlPart:
    """What one part of the model does to the Strehl ratio, see `estimate.correction.strehl_budget`."""

    name: str = item("", "Part of the model: all of it, its modes, or an effect.")
    wfe_nm: Number = item(nan, "RMS of its modes; NaN of an effect.")
    alone: Number = item(nan, "Strehl ratio with nothing else in the model, and with all else but this part.")
    without: Number = item(nan, DITTO)


@dataclass(frozen=True)
class OneSetup:
    """One of several set-ups, such as planes of known defocus, that were fitted together."""

    name: str = item("", "Its recordings.")
    introduced_nm: Number = item(nan, "Noll 4 of what is known of its wavefront.")
    frames: int = item(0, "Used frames.")
    chi2_nu: Number = item(nan, "Reduced χ² of its mean image.")
    focus_nm: Number = item(
        nan,
        "Defocus beyond the known and the common one that its image by itself wants, and the standard error.",
    )
    focus_sigma_nm: Number = item(nan, DITTO)
