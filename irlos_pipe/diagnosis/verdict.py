"""What a diagnosis says, in numbers and in one or two sentences."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from irlos_pipe.diagnosis import records
from irlos_pipe.diagnosis.cube import HeldOutKind
from irlos_pipe.diagnosis.moments import Moments
from irlos_pipe.diagnosis.sharing import Together
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.effects.public_values import measured

NONE: Final = "none"
EFFECT: Final = "effect"
UNKNOWN: Final = "unknown"
COMPLETE: Final = "complete"
PARTIAL: Final = "partial"
RESEMBLES: Final = "resembles"
Grade = Literal["none", "complete", "partial", "resembles", "unknown"]
Outcome = Literal["named", "nearest", "modelled", "adjusted", "fitted", "scored", "absorbed", "not tried"]


@dataclass(frozen=True)
class Sized:
    """An effect with its size and error."""

    effect: FixedEffect  # as it stands in the final model, nothing free
    public: dict[str, Any]  # parameters under public names
    sigma: dict[str, Any]  # their standard errors
    # Size as a report states it, see `Effect.shown`.
    shown: dict[str, Any] = field(default_factory=dict, kw_only=True)
    shown_sigma: dict[str, Any] = field(default_factory=dict, kw_only=True)  # its standard errors
    # Its opposite side, where these data do not exclude that.
    opposite: records.OppositeSide | None = field(default=None, kw_only=True)

    @property
    def phrase(self) -> str:
        """The effect with its size and error, as a sentence names it, and its opposite side."""
        sizes = measured(self.public, self.sigma) | measured(self.shown, self.shown_sigma)
        phrase = self.effect.phrase(sizes)
        other = self.opposite
        return phrase if other is None else f"{phrase} (or {other.phrase}, which these data do not exclude)"


@dataclass(frozen=True)
class Step(Sized):
    """One name, in the order found."""

    significance: float  # in Gaussian σ
    explained: float  # part of the excess that was there before
    preference: float  # Vuong's statistic on the held-out frames, against the model before
    gap: records.Gap  # on the held-out frames, of the models before and after it
    alternatives: Sequence[records.Alternative] = ()
    ranking: Sequence[records.Ranked] = ()  # families that were fitted, the best first
    label: str = ""  # of the effect among those of the final model; by default its name
    share: float = float("nan")  # part of its own signal that the final model explains where that signal lies

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name)

    @property
    def name(self) -> str:
        return self.effect.name

    def found_in(self, moments: Moments) -> list[str]:
        """Names of the `moments` in which it acts; none where it acts in all."""
        return [] if self.effect.acts_in is None else moments.names_of(self.effect.acts_in)

    @property
    def unusual(self) -> list[str]:
        """Parameters at a bound, or beyond what is usual for the effect."""
        return self.effect.base.unusual(self.effect.values)


@dataclass(frozen=True)
class Adjusted(Sized):
    """An effect that makes the final model fit better and is not named."""

    label: str  # of the effect among those of the final model
    # Distance of the parameter that differs most from null, or from what was declared, in standard errors.
    significance: float


@dataclass(frozen=True)
class Pictures:
    """Mean held-out image and its predictions [e-], all (rows, columns).

    The added OPD, (n, n) [nm], is NaN where the pupil is dark.
    """

    measured_e: np.ndarray
    sigma_e: np.ndarray
    before_e: np.ndarray
    after_e: np.ndarray
    leading: np.ndarray  # leading mode of the residual over the frames, over the standard error of a frame
    added_opd_nm: np.ndarray
    added_amplitude: np.ndarray


@dataclass(frozen=True)
class Diagnosis:
    """The whole verdict.

    A grade says that nothing is missing (none), nothing significant is left (complete), something else is
    missing as well (partial), the best name stands in for something that the catalogue lacks (resembles), or
    nothing explains what is missing (unknown).
    """

    verdict: Literal["none", "effect", "unknown"]
    grade: Grade
    steps: Sequence[Step]  # names accepted
    nearest: Step | None  # what comes nearest, where the verdict is unknown
    unexplained: bool  # whether a significant part of the residual is left
    why_unknown: str
    rest: records.Rest  # what the final model misses
    gap: records.Gap
    mdb: dict[str, dict]  # smallest detectable size of every effect that was not seen
    untestable: Sequence[str]  # effects that the free parameters absorb
    noise: records.NoiseVerdict
    # Left by the model with the names: whether pixels hold what no light can have made.
    fine: records.FineStructure
    chi2_nu: tuple[float, float]  # of the mean training image, before and after
    excess_sigma: tuple[float, float]
    motion_ratio: float
    drift_significance: float
    frames: tuple[int, int]  # number that fits saw, and number held out
    held_out: HeldOutKind  # what no fit saw
    nolls: tuple[int, ...]
    # Total Zernike coefficients before and after, in the order of `nolls`.
    modes_nm: tuple[np.ndarray, np.ndarray]
    modes_sigma_nm: np.ndarray
    pictures: Pictures
    # For those untestable that a second recording would show.
    advice: dict[str, records.Advice] = field(default_factory=dict)
    # Of the final model besides the steps: it fits better with them, but none is sure enough to be named.
    adjusted: Sequence[Adjusted] = ()
    # Further facts of the instrument that fits should leave free, see `open_facts`.
    open_facts: Sequence[FixedEffect] = ()
    tried: Sequence[records.Tried] = ()  # search log: every effect of the catalogue, and what became of it
    together: Together | None = None  # what the recordings share; None of a single star and night
    seconds: float = 0.0


OFF = 5.0  # standard errors from which a fact is said to differ from the declared one


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict of a diagnosis in one or two sentences."""
    return f"{_found(diagnosis)}{_advised(diagnosis)}{_weaker(diagnosis)}"


def _weaker(diagnosis: Diagnosis) -> str:
    """What held-out pixels cannot say."""
    if diagnosis.held_out == "frames":
        return ""
    return (
        f" Too few frames to hold some out ({diagnosis.frames[0]}): pixels that no fit has seen judge, "
        "errors come from the declared noise, scaled by the misfit, and neither speckles that did not "
        "average out nor changes with time can be distinguished from what the model lacks."
    )


def _found(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == NONE:
        return f"Nothing significant is missing in the model{_limit(diagnosis)}."
    if diagnosis.verdict == UNKNOWN:
        return f"{_unnamed(diagnosis)}: {diagnosis.why_unknown}. {diagnosis.rest.text}."
    lacking = _listed([f"{_phrase(step)}{_where(diagnosis, step)}" for step in diagnosis.steps])
    return f"Missing in the model: {lacking}{_others(diagnosis.steps)}; {_left(diagnosis)}."


def _listed(phrases: Sequence[str]) -> str:
    """Several phrases, which may have commas of their own, as a sentence lists them."""
    if len(phrases) < 3:
        return " and ".join(phrases)
    return f"{'; '.join(phrases[:-1])}; and {phrases[-1]}"


def _unnamed(diagnosis: Diagnosis) -> str:
    """That something is missing, and what it resembles."""
    nearest = diagnosis.nearest
    if diagnosis.grade == RESEMBLES and nearest is not None:
        return f"Something is missing that resembles {_phrase(nearest)} and is not that"
    near = "" if nearest is None else f" (the nearest is {_phrase(nearest)})"
    return f"Something is missing that nothing in the catalogue explains{near}"


def _left(diagnosis: Diagnosis) -> str:
    """What is missing besides the names."""
    if diagnosis.grade == PARTIAL:
        return f"something else is missing as well: {diagnosis.rest.text}{_adjusted(diagnosis)}"
    if diagnosis.unexplained:
        return "besides, the pixels hold structure finer than the telescope can make, as of a wrong flat"
    return f"nothing else is missing{_limit(diagnosis)}"


def _adjusted(diagnosis: Diagnosis) -> str:
    """Facts for which the data prefer other values, within what any instrument may have."""
    facts = [one for one in diagnosis.adjusted if one.effect.base.fact and one.significance > OFF]
    if not facts:
        return ""
    return f"; not named, as it may take up a part of that: {', '.join(one.phrase for one in facts)}"


def _phrase(step: Step) -> str:
    return step.phrase


def _where(diagnosis: Diagnosis, step: Step) -> str:
    """In which recordings a name is, and whether they share it."""
    together = diagnosis.together
    if together is None:
        return ""
    named = step.found_in(together.moments)
    where = f"in {' and '.join(named)}" if named else f"in all {len(together.moments.by_number)} recordings"
    findings = [one.finding for one in together.sharing if step.label in one.labels]
    words = {
        "common": "one value for all",
        "differs": "not in the others" if _alone(together, step) else "each recording has its own",
        "open": "the others would not show it",
    }
    return f" ({', '.join([where, *(words[one] for one in findings)])})"


def _alone(together: Together, step: Step) -> bool:
    """Whether the recordings in which a name is not found do not show it."""
    (sharing,) = (one for one in together.sharing if step.label in one.labels)
    return len(sharing.labels) == 1 and step.effect.acts_in is not None


def _advised(diagnosis: Diagnosis) -> str:
    """Which further recording would show what this one hides."""
    by_recording: dict[str, list[str]] = {}
    for name, advice in diagnosis.advice.items():
        by_recording.setdefault(advice.recording, []).append(name)
    shown = [
        f"{', '.join(names)} (a second recording {recording} would show it)"
        for recording, names in by_recording.items()
    ]
    return f" Untestable here: {'; '.join(shown)}." if shown else ""


def _others(steps: Sequence[Step]) -> str:
    others = [f"{step.label}: {other.name}" for step in steps for other in step.alternatives]
    return f" (not distinguished from {', '.join(others)})" if others else ""


def _limit(diagnosis: Diagnosis) -> str:
    kinds = [kind for kind in reversed(CATALOGUE.values()) if kind.limit and diagnosis.mdb.get(kind.name)]
    limits = [kind.limit.format(**diagnosis.mdb[kind.name]) for kind in kinds]
    return f" above {' or '.join(limits)}" if limits else ""
