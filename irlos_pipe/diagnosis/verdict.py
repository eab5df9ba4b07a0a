"""What a diagnosis says, and what a model still misses, in numbers and in one or two sentences."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np
import torch
from scipy import ndimage

from irlos_pipe.diagnosis import records
from irlos_pipe.diagnosis.acceptance import HeldOutEvaluation
from irlos_pipe.diagnosis.cube import HeldOutKind
from irlos_pipe.diagnosis.sharing import Together
from irlos_pipe.diagnosis.view import Moments
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.effects.public_values import measured
from irlos_pipe.optics.psf_settings import PsfSettings

SMOOTH_PX = 1.0  # of the residual, before its strongest part is looked for
HALF = 0.5  # part of the maximum down to which its strongest part reaches
ALIKE = 0.5  # correlation from which two halves show the same
CORE = 0.5  # part of the brightest pixel from which pixels belong to the star


def rest_of(
    judge: HeldOutEvaluation,
    floor: float,
    fine: records.FineStructure,
    sure: float,
    settings: PsfSettings,
    flat_rms: float = 0.0,
) -> records.Rest:
    """Describe what the final model leaves of the held-out frames of the first recording.

    Noise alone leaves a gap of `floor`; fine structure counts from `sure` σ; for `flat_rms` see there.
    """
    pixels, window = judge.pixels[0], settings.window
    image = judge.mean_e[pixels].reshape(window).numpy()
    left = _misplaced_e(judge, judge.stack.mean_e)[pixels].reshape(window).numpy()
    # centroid of the brightest pixels
    star_y, star_x = map(float, ndimage.center_of_mass(np.where(image > CORE * image.max(), image, 0.0)))
    row, column, area_px, sign = _strongest(left)
    scale = settings.pixel_scale_mas
    rest = records.Rest(
        light_fraction=float(np.sqrt(max(judge.gap**2 - floor**2, 0.0))),
        where=records.Where(
            (column - star_x) * scale, (row - star_y) * scale, 2 * float(np.sqrt(area_px / np.pi)) * scale
        ),
        excess=sign > 0,
        symmetry=_symmetry(left, star_y, star_x),
        time=_time(judge),
        finer_than_diffraction=fine.significance > sure,
        flat_rms=flat_rms,
    )
    return replace(rest, text=_text(rest))


def _text(rest: records.Rest) -> str:
    sign, at = "brighter" if rest.excess else "fainter", rest.where
    fine = ", partly finer than the diffraction limit" if rest.finer_than_diffraction else ""
    if fine and rest.flat_rms:
        fine += f" as an error of the flat of {rest.flat_rms:.2%} RMS would make it"
    when = "" if rest.time == "not seen" else f", {rest.time}"
    return (
        f"{rest.light_fraction:.1%} of the light is misplaced beyond noise, most of it "
        f"{at.x_mas:+.0f}, {at.y_mas:+.0f} mas from the star over {at.extent_mas:.0f} mas, where "
        f"the data are {sign}; {rest.symmetry}{when}{fine}"
    )


def _misplaced_e(judge: HeldOutEvaluation, mean_e: torch.Tensor) -> torch.Tensor:
    """What a mean image shows beyond the prediction, pointing and flux refitted, 0 in bad pixels [e-]."""
    root = judge.stack.root
    white = torch.where(root > 0, mean_e - judge.image, 0.0) * root
    white = white - judge.basis @ (judge.basis.mT @ white)
    return torch.where(root > 0, white / root.clamp_min(1e-300), 0.0)


def _strongest(left: np.ndarray) -> tuple[float, float, int, float]:
    """Row, column, pixels and sign of the connected part of `left` that holds its largest value."""
    calm = ndimage.gaussian_filter(left, SMOOTH_PX)
    peak = np.unravel_index(np.argmax(np.abs(calm)), calm.shape)
    sign = float(np.sign(calm[peak]))
    parts, _ = ndimage.label(sign * calm > HALF * abs(calm[peak]))
    own = parts == parts[peak]
    y, x = ndimage.center_of_mass(np.abs(calm), own)
    return float(y), float(x), int(own.sum()), sign


def _symmetry(left: np.ndarray, star_y: float, star_x: float) -> str:
    """How `left` changes under a half turn about the star."""
    rows, columns = (np.arange(size) for size in left.shape)
    y, x = np.meshgrid(2 * star_y - rows, 2 * star_x - columns, indexing="ij")
    turned = ndimage.map_coordinates(left, [y, x], order=1, cval=0.0)
    likeness = float((left * turned).sum() / max((left**2).sum(), 1e-300))
    if abs(likeness) < ALIKE:
        return "one-sided"
    return "symmetric" if likeness > 0 else "antisymmetric"


def _time(judge: HeldOutEvaluation) -> str:
    """Whether the two halves of the held-out frames of the first recording leave the same."""
    stack = judge.stack.parts[0]
    if judge.stack.held_out == "pixels" or len(stack) < 4:
        return "not seen"
    images = stack.frames.images_e.double().flatten(1)
    images = images * (images.sum(1).mean() / images.sum(1, keepdim=True))
    halves = []
    for half in (images[: len(images) // 2], images[len(images) // 2 :]):
        mean = judge.stack.mean_e.clone()
        mean[judge.pixels[0]] = half.mean(0)
        halves.append(_misplaced_e(judge, mean)[judge.pixels[0]])
    likeness = float(halves[0] @ halves[1] / (halves[0].norm() * halves[1].norm()).clamp_min(1e-300))
    return "static" if likeness > ALIKE else "moving"


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
    weaker = (
        f" Too few frames to hold some out ({diagnosis.frames[0]}): pixels that no fit has seen judge, "
        "errors come from the declared noise, scaled by the misfit, and neither speckles that did not "
        "average out nor changes with time can be distinguished from what the model lacks."
    )
    return f"{_found(diagnosis)}{_advised(diagnosis)}{'' if diagnosis.held_out == 'frames' else weaker}"


def _found(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == NONE:
        return f"Nothing significant is missing in the model{_limit(diagnosis)}."
    if diagnosis.verdict == UNKNOWN:
        return f"{_unnamed(diagnosis)}: {diagnosis.why_unknown}. {diagnosis.rest.text}."
    lacking = _listed([f"{step.phrase}{_where(diagnosis, step)}" for step in diagnosis.steps])
    others = [f"{step.label}: {other.name}" for step in diagnosis.steps for other in step.alternatives]
    alike = f" (not distinguished from {', '.join(others)})" if others else ""
    return f"Missing in the model: {lacking}{alike}; {_left(diagnosis)}."


def _listed(phrases: Sequence[str]) -> str:
    """Several phrases, which may have commas of their own, as a sentence lists them."""
    if len(phrases) < 3:
        return " and ".join(phrases)
    return f"{'; '.join(phrases[:-1])}; and {phrases[-1]}"


def _unnamed(diagnosis: Diagnosis) -> str:
    """That something is missing, and what it resembles."""
    nearest = diagnosis.nearest
    if diagnosis.grade == RESEMBLES and nearest is not None:
        return f"Something is missing that resembles {nearest.phrase} and is not that"
    near = "" if nearest is None else f" (the nearest is {nearest.phrase})"
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


def _where(diagnosis: Diagnosis, step: Step) -> str:
    """In which recordings a name is, and whether they share it."""
    together = diagnosis.together
    if together is None:
        return ""
    named = step.found_in(together.moments)
    where = f"in {' and '.join(named)}" if named else f"in all {len(together.moments.by_number)} recordings"
    for labels, one in together.sharing.items():
        if step.label in labels:
            alone = len(labels) == 1 and step.effect.acts_in is not None
            words = {
                "common": "one value for all",
                "differs": "not in the others" if alone else "each recording has its own",
                "open": "the others would not show it",
            }
            where = f"{where}, {words[one.finding]}"
    return f" ({where})"


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


def _limit(diagnosis: Diagnosis) -> str:
    kinds = [kind for kind in reversed(CATALOGUE.values()) if kind.limit and diagnosis.mdb.get(kind.name)]
    limits = [kind.limit.format(**diagnosis.mdb[kind.name]) for kind in kinds]
    return f" above {' or '.join(limits)}" if limits else ""
