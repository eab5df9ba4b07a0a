"""Parts of a diagnosis that results.json holds as they are: every key is a field, described here only."""

import math
from dataclasses import dataclass
from typing import Any

from irlos_pipe.conventions.keys import Number, key


@dataclass(frozen=True)
class Alternative:
    """An effect not distinguished from the one found, see `diagnosis.acceptance`."""

    name: str = key("", "Name of the effect.")
    reason: str = key("", "Why the two are not distinguished.")
    separated_by: str = key("", "What separates the two.")
    likeness: Number = key(
        math.nan,
        "|cos| between what the two add to the image, beyond what the fitted parameters imitate; 1: alike.",
    )
    second_recording: str = key("", "How a further recording differs with which they are least alike.")
    likeness_then: Number = key(math.nan, "|cos| with that recording.")


@dataclass(frozen=True)
class Ranked:
    """A candidate when an effect was chosen."""

    name: str = key("", "Name of the candidate.")
    gain: Number = key(math.nan, "Fall of χ² by the fit.")
    explained: Number = key(math.nan, "Part of the excess over noise that it explains.")
    significance: Number = key(math.nan, "Significance in Gaussian σ.")
    held_out_z: Number = key(
        math.nan, "Vuong's statistic for the first of all against it, on data that no fit has seen."
    )


@dataclass(frozen=True)
class OppositeSide:
    """A fit with the effect on its opposite side that these data do not exclude, see `diagnosis.opposite`."""

    parameters: dict[str, Any] = key({}, "Values there by name of the parameter.")
    phrase: str = key("", "The effect there, as a sentence names it.")
    chi2_rise: Number = key(
        math.nan,
        "χ² and priors there over those of the model, in units of their scatter; negative if it fits better.",
    )
    wavefront_change_nm: Number = key(
        math.nan, "RMS by which the wavefronts of both fits differ, tip and tilt apart."
    )


@dataclass(frozen=True)
class Advice:
    """A second recording that shows an effect, see `diagnosis.second_recording`."""

    recording: str = key("", "What the second recording should be, in words.")
    survival: Number = key(
        math.nan, "Part of the signature of the effect that the fitted parameters cannot imitate there."
    )
    smallest: dict[str, Any] = key(
        {}, "Smallest detectable size of the effect with it, by name of the parameter."
    )


@dataclass(frozen=True)
class FineStructure:
    """Structure finer than the telescope can make, see `diagnosis.checks.fine_structure`."""

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
