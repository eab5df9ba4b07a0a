"""Choices of a diagnosis, and its parts that results.json holds as they are, described here only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from typing import Any

from irlos_pipe.conventions.keys import DITTO, Number, key

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


@dataclass(frozen=True)
class Alternative:
    """An effect not distinguished from the one found, see `diagnosis.acceptance`."""

    name: str = key("", "Name of the effect.")
    reason: str = key("", "Why the two are not distinguished.")
    separated_by: str = key("", "What separates the two.")
    likeness: Number = key(
        nan,
        "|cos| between what the two add to the image, beyond what the fitted parameters imitate; 1: alike.",
    )
    second_recording: str = key("", "How a further recording differs with which they are least alike.")
    likeness_then: Number = key(nan, "|cos| with that recording.")


@dataclass(frozen=True)
class Ranked:
    """A candidate when an effect was chosen."""

    name: str = key("", "Name of the candidate.")
    gain: Number = key(nan, "Fall of χ² by the fit.")
    explained: Number = key(nan, "Part of the excess over noise that it explains.")
    significance: Number = key(nan, "Significance in Gaussian σ.")
    held_out_z: Number = key(
        nan, "Vuong's statistic for the first of all against it, on data that no fit has seen."
    )


@dataclass(frozen=True)
class OppositeSide:
    """A fit with the effect on its opposite side that these data do not exclude, see `diagnosis.workflow`."""

    parameters: dict[str, Any] = key({}, "Values there by name of the parameter.")
    phrase: str = key("", "The effect there, as a sentence names it.")
    chi2_rise: Number = key(
        nan,
        "χ² and priors there over those of the model, in units of their scatter; negative if it fits better.",
    )
    wavefront_change_nm: Number = key(
        nan, "RMS by which the wavefronts of both fits differ, tip and tilt apart."
    )


@dataclass(frozen=True)
class Advice:
    """A second recording that shows an effect, see `diagnosis.second_recording`."""

    recording: str = key("", "What the second recording should be, in words.")
    survival: Number = key(
        nan, "Part of the signature of the effect that the fitted parameters cannot imitate there."
    )
    smallest: dict[str, Any] = key(
        {}, "Smallest detectable size of the effect with it, by name of the parameter."
    )


@dataclass(frozen=True)
class FineStructure:
    """Structure finer than the telescope can make, see `diagnosis.checks`."""

    ratio: Number = key(
        1.0,
        "Power of the residual beyond the cut-off D/λ, over what noise leaves there; 1 where the pixels are "
        "too coarse or too few to show it.",
    )
    significance: Number = key(
        0.0,
        "Of its excess, in standard deviations; of few frames no excess is significant, however strong it "
        "is.",
    )


@dataclass(frozen=True)
class Gap:
    """``Σ|measured − predicted| / Σ measured`` of the held-out frames."""

    before: Number = key(nan, "With the model as it was, and with what was found.")
    after: Number = key(nan, DITTO)
    floor: Number = key(nan, "What noise alone leaves.")
    shrink: Number = key(nan, "(before − after) / (before − floor).")

    def __post_init__(self) -> None:
        above = self.before - self.floor
        shrink = (self.before - self.after) / above if above > 0 else nan
        object.__setattr__(self, "shrink", shrink)

    @property
    def closed(self) -> float:
        """The same of the squares, in which noise and what a model misses add; NaN where there was none."""
        above = self.before**2 - self.floor**2
        return (self.before**2 - self.after**2) / above if above > 0 else nan


@dataclass(frozen=True)
class Tried:
    """What became of an effect of the catalogue."""

    effect: str = key("", "Name of the effect.")
    outcome: str = key(
        "",
        "``named``; ``nearest``, where the verdict is unknown; ``modelled`` from the start; ``adjusted``, "
        "not named; ``fitted``, explains less; ``scored``, not significant; ``absorbed``, not to be seen; "
        "``not tried``.",
    )
    significance: Number = key(
        nan, "Of its score test at the last model for which a name was looked for, in Gaussian σ."
    )
    reason: str = key("", "Why, in words.")


@dataclass(frozen=True)
class NoiseVerdict:
    """Whether the noise model holds, see `diagnosis.checks`."""

    kind: str = key("", "``photon-limited``, ``speckle-limited``, or ``unseen`` of a single frame.")
    bright_ratio: Number = key(nan, "Measured over predicted variance of bright and of faint pixels.")
    faint_ratio: Number = key(nan, DITTO)
    holds: bool = key(True, "Whether the noise model explains the scatter of the frames.")
    text: str = key("", "The same in words.")


@dataclass(frozen=True)
class Where:
    """The strongest part of what is left, from the star, x to the right and y up [mas]."""

    x_mas: Number = key(nan, "Position from the star, to the right and up.")
    y_mas: Number = key(nan, DITTO)
    extent_mas: Number = key(nan, "Diameter of a disc as large.")


@dataclass(frozen=True)
class Rest:
    """What the model still misses, see `diagnosis.verdict`."""

    light_fraction: Number = key(nan, "Part of the light that is misplaced beyond what noise alone shows.")
    where: Where = Where()
    excess: bool = key(False, "Whether the strongest part is too bright in the data, not too faint.")
    symmetry: str = key(
        "", "``symmetric``, ``antisymmetric`` or ``one-sided``, under a half turn about the star."
    )
    time: str = key(
        "", "Whether the two halves of the frames leave the same: ``static``, ``moving`` or ``not seen``."
    )
    finer_than_diffraction: bool = key(False, "Whether a part of it is finer than the telescope can make.")
    flat_rms: Number = key(
        0.0, "Relative error of the flat that would make what is finer; 0 where none is distinguished."
    )
    text: str = key("", "All of it in a sentence.")


@dataclass(frozen=True)
class OwnValueRow:
    """What one star and night has of an effect."""

    recording: str = key("", "Name of the star and night.")
    parameters: dict[str, Any] = key({}, "Values and standard errors by name of the parameter.")
    sigma: dict[str, Any] = key({}, DITTO)
    significance: Number = key(nan, "Of its presence there, in Gaussian σ.")


@dataclass(frozen=True)
class SharingRow:
    """Whether stars and nights share an effect, see `diagnosis.sharing`."""

    effect: str = key("", "Name of the effect.")
    finding: str = key("", "``common``, ``differs``, or ``open`` where these data do not tell.")
    significance: Number = key(nan, "Of the differences, in Gaussian σ.")
    chi2_fall: Number = key(nan, "By which χ² falls with a value of each, for so many more `parameters`.")
    parameters: int = key(0, "Further parameters that values of each take.")
    held_out_z: Number = key(nan, "Vuong's statistic for a value of each against one for all.")
    values: list[OwnValueRow] = key([], "What each star and night has of it.")


@dataclass(frozen=True)
class Star:
    """One star and night, and by how much its wavefront differs from the common one."""

    name: str = key("", "Name of the star and night, and of the star.")
    star: str = key("", DITTO)
    ncpa_change_nm: Number = key(
        nan, "RMS over the modes of the change from the common wavefront, and of its standard errors."
    )
    sigma_nm: Number = key(nan, DITTO)
