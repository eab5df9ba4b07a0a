"""Parts of a diagnosis that results.json holds as they are: every key is a field, described here only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from irlos_pipe.conventions.numbers import Number


@dataclass(frozen=True)
class Alternative:
    """An effect not distinguished from the one found, see `diagnosis.held_out`.

    Attributes
    ----------
    name : str
        Name of the effect.
    reason : str
        Why the two are not distinguished.
    separated_by : str
        What separates the two.
    likeness : float
        |cos| between what the two add to the image, beyond what the fitted parameters imitate; 1: alike.
    second_recording : str
        How a further recording differs with which they are least alike.
    likeness_then : float
        |cos| with that recording.
    """

    name: str = ""
    reason: str = ""
    separated_by: str = ""
    likeness: Number = math.nan
    second_recording: str = ""
    likeness_then: Number = math.nan


@dataclass(frozen=True)
class Ranked:
    """A candidate when an effect was chosen.

    Attributes
    ----------
    name : str
        Name of the candidate.
    gain : float
        Fall of χ² by the fit.
    explained : float
        Part of the excess over noise that it explains.
    significance : float
        Significance in Gaussian σ.
    held_out_z : float
        Vuong's statistic for the first of all against it, on data that no fit has seen.
    """

    name: str = ""
    gain: Number = math.nan
    explained: Number = math.nan
    significance: Number = math.nan
    held_out_z: Number = math.nan


@dataclass(frozen=True)
class OppositeSide:
    """A fit with the effect on its opposite side that these data do not exclude, see `diagnosis.opposite`.

    Attributes
    ----------
    parameters : dict
        Values there by name of the parameter.
    phrase : str
        The effect there, as a sentence names it.
    chi2_rise : float
        χ² and priors there over those of the model, in units of their scatter; negative if it fits better.
    wavefront_change_nm : float
        RMS by which the wavefronts of both fits differ, tip and tilt apart.
    """

    parameters: dict[str, Any] = field(default_factory=dict)
    phrase: str = ""
    chi2_rise: Number = math.nan
    wavefront_change_nm: Number = math.nan


@dataclass(frozen=True)
class Advice:
    """A second recording that shows an effect, see `diagnosis.second_recording`.

    Attributes
    ----------
    recording : str
        What the second recording should be, in words.
    survival : float
        Part of the signature of the effect that the fitted parameters cannot imitate there.
    smallest : dict
        Smallest detectable size of the effect with it, by name of the parameter.
    """

    recording: str = ""
    survival: Number = math.nan
    smallest: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FineStructure:
    """Structure finer than the telescope can make, see `diagnosis.checks.fine_structure`.

    Attributes
    ----------
    ratio : float
        Power of the residual beyond the cut-off D/λ, over what noise leaves there; 1 where the pixels are too
        coarse or too few to show it.
    significance : float
        Of its excess, in standard deviations; of few frames no excess is significant, however strong it is.
    """

    ratio: Number = 1.0
    significance: Number = 0.0
