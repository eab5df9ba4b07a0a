"""What a diagnosis says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from irlos_pipe.diagnose.ambiguity import Alternative
from irlos_pipe.diagnose.checks.fine_structure import FineStructure
from irlos_pipe.diagnose.checks.noise import NoiseVerdict
from irlos_pipe.diagnose.cube import HeldOutKind
from irlos_pipe.diagnose.held_out import Gap
from irlos_pipe.diagnose.moments import Moments
from irlos_pipe.diagnose.rest import Rest
from irlos_pipe.diagnose.second_recording import Advice
from irlos_pipe.diagnose.sharing import Together
from irlos_pipe.effects import FixedEffect

NONE: Final = "none"
EFFECT: Final = "effect"
UNKNOWN: Final = "unknown"
COMPLETE: Final = "complete"
PARTIAL: Final = "partial"
RESEMBLES: Final = "resembles"
Grade = Literal["none", "complete", "partial", "resembles", "unknown"]


@dataclass(frozen=True)
class Ranked:
    """One family as it stood when a name was chosen.

    Attributes
    ----------
    gain : float
        Fall of χ² by the fit.
    explained : float
        Part of the excess that it explains.
    significance : float
        In Gaussian σ.
    """

    name: str
    gain: float
    explained: float
    significance: float


@dataclass(frozen=True)
class Step:
    """One name, in the order found.

    Attributes
    ----------
    effect : FixedEffect
        As it stands in the final model, nothing free.
    public, sigma : dict
        Parameters and standard errors under public names.
    significance : float
        In Gaussian σ.
    explained : float
        Part of the excess that was there before.
    preference : float
        Vuong's statistic on the held-out frames, against the model before.
    gap : Gap
        On the held-out frames, of the models before and after it.
    alternatives : sequence of Alternative
    ranking : sequence of Ranked
        Families that were fitted, the best first.
    label : str
        Of the effect among those of the final model; by default its name.
    share : float
        Part of its own signal that the final model explains where that signal lies.
    """

    effect: FixedEffect
    public: dict[str, Any]
    sigma: dict[str, Any]
    significance: float
    explained: float
    preference: float
    gap: Gap
    alternatives: Sequence[Alternative] = ()
    ranking: Sequence[Ranked] = ()
    label: str = ""
    share: float = float("nan")

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name)

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    def found_in(self, moments: Moments) -> list[str]:
        """Names of the `moments` in which it acts; none where it acts in all."""
        return [] if self.effect.acts_in is None else moments.names_of(self.effect.acts_in)

    @property
    def unusual(self) -> list[str]:
        """Parameters at a bound, or beyond what is usual for the effect."""
        return self.effect.base.unusual(self.effect.values)


@dataclass(frozen=True)
class Pictures:
    """Mean held-out image and its predictions [e-], all (rows, columns); added OPD (n, n) [nm].

    Attributes
    ----------
    leading : ndarray
        Leading mode of the residual over the frames, over the standard error of a frame.
    """

    measured_e: np.ndarray
    sigma_e: np.ndarray
    before_e: np.ndarray
    after_e: np.ndarray
    leading: np.ndarray
    added_opd_nm: np.ndarray
    added_amplitude: np.ndarray


@dataclass(frozen=True)
class Diagnosis:
    """The whole verdict.

    Attributes
    ----------
    verdict : {"none", "effect", "unknown"}
    grade : {"none", "complete", "partial", "resembles", "unknown"}
        Nothing is missing; nothing significant is left; something else is missing as well; the best name
        stands in for something that the catalogue lacks; nothing explains what is missing.
    steps : sequence of Step
        Names accepted.
    nearest : Step or None
        What comes nearest, where the verdict is unknown.
    unexplained : bool
        Whether a significant part of the residual is left.
    why_unknown : str
    rest : Rest
        What the final model misses.
    adjusted : sequence of FixedEffect
        Of the final model beside the steps: it fits better with them, but none is sure enough to be named.
    mdb : dict
        Smallest detectable size of every effect that was not seen.
    untestable : sequence of str
        Effects that the free parameters absorb.
    advice : dict of str to Advice
        For those of them that a second recording beside this one would show.
    fine : FineStructure
        Left by the model with the names: whether pixels hold what no light can have made.
    frames : (int, int)
        That fits saw, and held out.
    held_out : {"frames", "pixels"}
        What no fit saw.
    chi2_nu : (float, float)
        Of the mean training image over its expectation, before and after.
    together : Together or None
        What the recordings share; None of a single star and night.
    modes_nm : (ndarray, ndarray)
        Total Zernike coefficients before and after, in the order of `nolls`.
    """

    verdict: Literal["none", "effect", "unknown"]
    grade: Grade
    steps: Sequence[Step]
    nearest: Step | None
    unexplained: bool
    why_unknown: str
    rest: Rest
    gap: Gap
    mdb: dict[str, dict]
    untestable: Sequence[str]
    noise: NoiseVerdict
    fine: FineStructure
    chi2_nu: tuple[float, float]
    excess_sigma: tuple[float, float]
    motion_ratio: float
    drift_significance: float
    frames: tuple[int, int]
    held_out: HeldOutKind
    nolls: tuple[int, ...]
    modes_nm: tuple[np.ndarray, np.ndarray]
    modes_sigma_nm: np.ndarray
    pictures: Pictures
    advice: dict[str, Advice] = field(default_factory=dict)
    adjusted: Sequence[FixedEffect] = ()
    together: Together | None = None
    seconds: float = 0.0
