"""Why a calibration failed: the fact or effect that would explain the misfit, and its value.

Every suspect is a change of the model by a few parameters, or other optics. A linear test at the optimum
(`score_test`; of other optics the difference of the images) says which are worth a refit. There all modes
are free for a few Gauss–Newton steps: they have bent to imitate what is declared wrongly, so that the linear
step is too short. What a suspect explains is its fall of χ² over what χ² lies above nominal. Suspects that
explain as much come in the order in which they are to blame. How unlikely the estimated modes are by their
law says whether another diversity was in the light than the declared one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
import torch
from numpy.polynomial.legendre import legval

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, placed
from irlos_pipe.conventions.pupil_parts import Placement
from irlos_pipe.effects import Conditions, Effect, FixedEffect
from irlos_pipe.effects.colour import Anamorphism, PlateScale, Spectrum
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.declaration import Parameter
from irlos_pipe.effects.detector import DetectorNonlinearity, InterpixelCrosstalk
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.motion import TipTiltJitter, Vibration
from irlos_pipe.effects.planes import DetectorEffect
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration, PupilSizes
from irlos_pipe.effects.seeing_halo import SeeingHalo
from irlos_pipe.estimate.calibration_options import DEFAULT_METHOD, METHODS, Cause, NcpaPrior
from irlos_pipe.estimate.cube import local_mean
from irlos_pipe.estimate.image_fit import ImageFit, like
from irlos_pipe.estimate.score_test import LinearEstimate, NullModel, derivatives, frozen_effects, null_model
from irlos_pipe.frames.told import SMALLEST_NM
from irlos_pipe.numerics.solver import INVALID, solve
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.pupil import band_limited

WORTH_REFIT, WORTH_NAMING = 0.02, 0.1  # parts of the misfit: by the linear test, and after the refit
EXPLAINED = 0.5  # part of the misfit that what is to blame explains: a fact, modes beyond the closed basis
ENOUGH = 0.9  # part of the misfit from which other optics, and other minima, are not tried
ALIKE = 0.03  # part of the misfit by which causes explain as much as the best
AS_PROMISING = 0.3  # of the best promise: others are not refitted once enough is explained
# Suspects that are refitted, as places at which a second star is looked for; their steps.
REFITS, STEPS = 4, 4
BEST, FURTHER, AFRESH = 2, 10, 15  # those that are followed, their steps, and those of fits without modes
TRIAL, TRIAL_MODES = 6, 20  # steps and modes of fits that begin without modes, the best of which go on
MOST_MODES = METHODS[DEFAULT_METHOD].highest_noll - 1  # that are free in a refit: those of the closed basis
FAR = 0.1  # relative error of the scale from which the end of the spectrum says where to begin
TURNS_DEG = (-25.0, -12.0, 12.0, 25.0)
DRAWN, SAME = 64, 0.003  # samples of drawings that are compared; mean square of the difference of one pupil
DIVERSE_NOLLS = (4, 5, 6, 7, 8, 9, 10, 11)  # modes in which a diversity may be
ALIKE_NOLLS = (5, 6)  # most easily mistaken for each other
UNLIKELY = 4.0  # of -2 ln of a probability: difference that counts
RESIDUAL, PROFILE, MODES = "cal-residual", "cal-profile", "cal-ncpa"
ORIENTATIONS = {
    "transposed": Placement(90.0, True),
    "flipped left to right": Placement(180.0, True),
    "flipped up and down": Placement(0.0, True),
    "turned by 90°": Placement(90.0),
    "turned by -90°": Placement(-90.0),
    "turned by 180° (or, which looks the same, a diversity of the other sign)": Placement(180.0),
    "transposed about the other diagonal": Placement(-90.0, True),
}


@dataclass(frozen=True)
class Asked:
    """What is known besides the fit: χ²/ν that is nominal, pupils of other profiles by name."""

    conditions: Conditions | None  # for an AO residual
    nominal: float  # in units of the fit
    cutoff: float = math.nan  # where detail ends over D/λ, see `frames.told.cutoff_ratio`
    profile: str = ""
    pupils: Mapping[str, PupilGeometry] = field(default_factory=dict)


@dataclass(frozen=True)
class Suspect:
    """A change of the model: an effect, other optics, or both."""

    name: str
    key: str
    # by the free values of the effect: in words, and as a number to compare with the `declared` one
    phrase: Callable[[np.ndarray], str]
    value: Callable[[np.ndarray], float] | None = None
    declared: float = math.nan
    unit: str = ""
    effect: Effect | None = None
    settings: PsfSettings | None = None
    starts: Sequence[Sequence[float]] = ()  # free values from which a refit may begin, besides the estimate
    figure: str = RESIDUAL

    @property
    def begun(self) -> list[np.ndarray]:
        """All values of the effect where a refit may begin without a linear estimate."""
        if self.effect is None:
            return [np.empty(0)]
        starts = self.starts or [[p.start for p in self.effect.parameters]]
        return [self.effect.all_values(one).numpy() for one in starts]

    @property
    def optics(self) -> bool:
        """Whether a test needs images of other optics."""
        return self.settings is not None or bool(self.starts)


class Scale(PlateScale):
    """A plate scale that is wrong by any factor."""

    parameters = (Parameter("fraction", "", 0.0, lower=-0.8, upper=4.0),)


class Backdrop(DetectorEffect):
    """Smooth light behind the star: Legendre polynomials in x and y up to the third order."""

    name = "background"
    order = 2

    def __init__(self, window: tuple[int, int]):
        (rows, columns), units = [np.linspace(-1, 1, size) for size in window], np.eye(4)
        powers = [(i, j) for i in range(4) for j in range(4 - i) if i + j]
        maps = [np.outer(legval(rows, units[i]), legval(columns, units[j])) for i, j in powers]
        self.maps = torch.tensor(np.array(maps))
        self.parameters = tuple(Parameter(f"e_{i}{j}", "e-", 0.0) for i, j in powers)

    def apply(self, values: torch.Tensor, images_e: torch.Tensor) -> torch.Tensor:
        return images_e + torch.tensordot(values, self.maps, 1).to(images_e.device)

    def range_e(self, values: np.ndarray) -> float:
        """Return the largest difference in the window [e-]."""
        return float(np.ptp(np.tensordot(values, self.maps.numpy(), 1)))

    def words(self, values: np.ndarray) -> str:
        return f"a dark that was not subtracted, whose level differs by {self.range_e(values):.3g} e⁻,"


class Neighbour(Companion):
    """A second star, looked for at a few places (x, y) [mas]."""

    def __init__(self, places: Sequence[tuple[float, float]], reach_mas: float):
        super().__init__(reach_mas=reach_mas)
        self.places = places

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[FixedEffect]:
        return [self.displaced(*place) for place in self.places]


# -- suspects ------------------------------------------------------------------------------------


def suspects(problem: ImageFit, null: NullModel, asked: Asked) -> Iterator[Suspect]:
    """Yield what may be declared wrongly or left out, those first that are to blame more often."""
    settings, geometry = problem.model.psf.settings, problem.model.psf.settings.geometry
    mas, nm, metres, span = settings.pixel_scale_mas, settings.mean_nm, geometry.diameter_m, settings.span_nm

    def scale(v: np.ndarray) -> str:
        factor = 1 + v[0]
        pixels = f"pixels of {mas * factor:.4g} mas instead of {mas:.4g} mas"
        pupil = f"a pupil of {metres * factor:.3g} m instead of {metres:.3g} m"
        light = f"a wavelength of {nm / factor:.5g} nm instead of {nm:.5g} nm"
        if abs(v[0]) > FAR:
            return f"{pupil}, thus a profile of another telescope (or, which looks the same, {pixels})"
        return f"{pixels} (or, which looks the same, {light}, or {pupil})"

    def size(v: np.ndarray) -> float:
        return mas * (1 + float(v[0]))

    far = [[asked.cutoff - 1]] if abs(asked.cutoff - 1) > FAR else []
    yield Suspect("plate_scale", "pixel_scale_mas", scale, size, mas, "mas", Scale(mas), None, far)
    for words, pupil in _distinct(geometry):
        yield Suspect(
            "orientation", "pupil.flip", _text(f"images {words}"), settings=replace(settings, geometry=pupil)
        )
    for name, pupil in asked.pupils.items():
        ratio = asked.cutoff * metres / pupil.diameter_m
        text = _text(f"the pupil of the profile {name} instead of that of {asked.profile}")
        starts, other = [[0.0], [ratio - 1 if np.isfinite(ratio) else 0.0]], replace(settings, geometry=pupil)
        yield Suspect("profile", "instrument", text, effect=Scale(mas), settings=other, starts=starts)
    if geometry.vanes or not geometry.plain:
        turn = FixedEffect(PupilMisregistration(), [0.0, 0.0, 0.0], free=("rotation_deg",))
        starts, key = [[angle] for angle in TURNS_DEG], "pupil_rotation_deg"
        turned = "a pupil turned by {:+.1f}°".format
        yield Suspect(
            "pupil_rotation", key, lambda v: turned(*v), lambda v: float(v[0]), 0.0, "deg", turn, None, starts
        )
    yield _dark(settings)
    if geometry.vanes:
        bare = replace(settings, geometry=replace(geometry, vanes=()))
        yield Suspect("pupil_geometry", "pupil.vanes", _text("a pupil without vanes"), settings=bare)
    if span:
        width = FixedEffect(Spectrum(nm), [0.0] * 3, free=("stretch",))
        band = f"a band {{:.3g}} nm wide instead of {span:.3g} nm".format
        yield Suspect(
            "spectrum", "spectrum", lambda v: band(span * (1 + v[0])), lambda v: span * (1 + float(v[0])),
            span, "nm", width,
        )  # fmt: skip
    present = {effect.name for effect in problem.model.effects.effects}
    stop = FixedEffect(PupilMisregistration(), [0.03, 0.0, 0.0], free=("distance_m", "direction_rad"))
    listed: list[tuple[Callable[[], Effect], str, str]] = [
        (TipTiltJitter, "motion", "model.effects"),
        (InterpixelCrosstalk, "interpixel_crosstalk", "model.effects"),
        (DetectorNonlinearity, "detector_nonlinearity", "detector.saturation_adu"),
        (lambda: Vibration("gaussian"), "motion", "model.effects"),
        (Anamorphism, "anamorphism", "model.effects"),
        (
            lambda: Neighbour(_brightest(problem, null), mas * max(settings.window)),
            "companion",
            "model.effects",
        ),
    ]
    if asked.conditions is not None:
        listed.insert(1, (partial(SeeingHalo.under, asked.conditions), "seeing_halo", "model.effects"))
    if geometry.plain:  # drawing others again takes minutes
        listed.insert(2, (lambda: PupilSizes(geometry), "pupil_geometry", "pupil"))
        listed.insert(-1, (lambda: stop, "pupil_misregistration", "pupil"))
    for make, name, key in listed:
        with suppress(ValueError):  # it means nothing here
            effect = make()
            if effect.name not in present:
                yield _lacking(name, key, effect)


def _dark(settings: PsfSettings) -> Suspect:
    light = Backdrop(settings.window)
    return Suspect("background", "dark", light.words, light.range_e, 0.0, "e-", light, figure=PROFILE)


def _lacking(name: str, key: str, effect: Effect) -> Suspect:
    """An effect that the model may lack, with all its parameters."""
    public = effect.public[0]
    unit = public.unit.split(",")[0].split(" ")[0]

    def value(v: np.ndarray) -> float:
        return float(effect.shown(v)[public.name])

    return Suspect(name, key, lambda v: effect.phrase(effect.shown(v)), value, 0.0, unit, effect)


def _text(words: str) -> Callable[[np.ndarray], str]:
    return lambda _: words


def _distinct(geometry: PupilGeometry) -> list[tuple[str, PupilGeometry]]:
    """The orientations that the pupil distinguishes from the declared one, those that look alike as one."""
    declared = band_limited(geometry, DRAWN)
    kinds: list[tuple[list[str], PupilGeometry, np.ndarray]] = [([], geometry, declared)]
    for words, placement in ORIENTATIONS.items():
        pupil = placed(geometry, placement)
        drawing = band_limited(pupil, DRAWN)
        alike = [names for names, _, one in kinds if np.sum((drawing - one) ** 2) < SAME * np.sum(one**2)]
        if alike:
            alike[0].append(words)
        else:
            kinds.append(([words], pupil, drawing))
    return [(" or ".join(names), pupil) for names, pupil, _ in kinds[1:]]


def _brightest(problem: ImageFit, null: NullModel) -> list[tuple[float, float]]:
    """Places (x, y) [mas] beyond λ/D from the star where most is left of the image."""
    settings = problem.model.psf.settings
    residual, root = (one.reshape(settings.window) for one in (null.residual, null.root))
    left = local_mean(residual, (root > 0).double()).numpy()
    y, x = np.indices(left.shape) - (np.array(left.shape) - 1)[:, None, None] / 2
    places: list[tuple[float, float]] = []
    for _ in range(REFITS):
        near = [np.hypot(x - u, y - v) < settings.resolution_px for u, v in [(0, 0), *places]]
        at = np.unravel_index(np.argmax(np.where(np.any(near, axis=0), -np.inf, left)), left.shape)
        places.append((float(x[at]), float(y[at])))
    return [(u * settings.pixel_scale_mas, v * settings.pixel_scale_mas) for u, v in places]


def _other_diversities(settings: PsfSettings) -> Iterator[Suspect]:
    """The declared diversity with the other sign, in another mode, or not there."""
    known, declared = settings.known, {noll: nm for noll, nm in settings.known.diversity_nm.items() if nm}
    for noll, nm in declared.items() if len(declared) == 1 else ():
        for mode, size in [(noll, -nm), (noll, 0.0), *((one, nm) for one in ALIKE_NOLLS if one != noll)]:
            text = _text(f"a diversity of {size:g} nm in Noll {mode} instead of {nm:g} nm in Noll {noll}")
            changed = replace(settings, known=replace(known, diversity_nm={mode: size}))
            yield Suspect("diversity", "diversity", text, settings=changed, figure=MODES)


# -- tests ---------------------------------------------------------------------------------------


def causes_of_misfit(
    problem: ImageFit, x: torch.Tensor, asked: Asked, *, facts_only: bool = False
) -> list[Cause]:
    """Return what would explain that χ²/ν of a mean image is above nominal, most likely first.

    The `problem` has one member, with its optimum at `x` (1, parameters). Other optics are tried where no
    effect explains enough, and then fits that begin with no modes: the optimum may be a wrong minimum. With
    `facts_only` nothing is tried but values of what is declared of the instrument.
    """
    problem, x = _with_few_modes(problem, x)
    null = null_model(problem, x)
    chi2 = float(null.residual.square().sum())
    misfit = max(chi2 - asked.nominal * problem.freedom, 1e-3 * chi2)
    every, found = list(suspects(problem, null, asked)), []
    if facts_only:
        every = [one for one in every if not one.optics and one.effect is not None and one.effect.base.fact]

    def add(suspect: Suspect, fit: _Fit) -> float:
        found.append((min(1.0, (chi2 - fit.chi2) / misfit), suspect, fit))
        found.sort(key=lambda one: -one[0])
        return found[0][0]

    best = 0.0
    for optics in (False, True):
        some = _tested(problem, x, null, [one for one in every if one.optics == optics])
        tests = sorted(some, key=lambda one: -one[0])
        for gain, suspect, fit in tests[:REFITS]:
            if gain > WORTH_REFIT * misfit and (best < ENOUGH or gain > AS_PROMISING * tests[0][0]):
                best = add(suspect, fit.further(STEPS))
        for _, suspect, fit in [found.pop(0) for _ in found[:BEST]]:
            best = add(suspect, fit.further(FURTHER))
        if best >= ENOUGH or facts_only:
            break
    else:
        blank = x.clone()
        blank[:, 2 : len(problem.layout.nolls)] = 0.0
        every += _other_diversities(problem.model.psf.settings)
        trial, tried = _fewer(problem, blank, TRIAL_MODES), []
        for suspect in [one for one in every if one.settings is not None or one.name == "plate_scale"]:
            with suppress(ValueError):
                tried.append((suspect, _Fit.of(*trial, suspect, suspect.begun[-1]).further(TRIAL)))
        for suspect, fit in sorted(tried, key=lambda one: one[1].chi2)[:REFITS]:
            best = add(suspect, fit.with_modes(problem, blank, suspect).further(AFRESH - TRIAL))
    found.sort(key=lambda one: (every.index(one[1]) if one[0] > best - ALIKE else len(every), -one[0]))
    rows = [fit.cause(suspect, part) for part, suspect, fit in found if part > WORTH_NAMING]
    first = {row.name: row for row in reversed(rows)}
    return [row for row in rows if first[row.name] is row]


def dark_left_in(problem: ImageFit, x: torch.Tensor) -> list[Cause]:
    """Return a dark that was not subtracted, if it is there: taken for photons it makes χ²/ν too small."""
    problem, x = _with_few_modes(problem, x)
    dark = _dark(problem.model.psf.settings)
    fit = _Fit.of(problem, x, dark, dark.begun[0]).further(STEPS)
    part = 1 - fit.chi2 / _Fit(problem, x, ()).chi2
    return [fit.cause(dark, part)] if part > WORTH_NAMING else []


def _with_few_modes(problem: ImageFit, x: torch.Tensor) -> tuple[ImageFit, torch.Tensor]:
    """The fit without its highest modes, where there are many: they imitate what is declared wrongly."""
    if len(problem.layout.nolls) <= MOST_MODES:
        return problem, x
    fit = _Fit(*_fewer(problem, x, MOST_MODES), ()).further(AFRESH)
    return fit.problem, fit.x


def _fewer(problem: ImageFit, x: torch.Tensor, kept: int) -> tuple[ImageFit, torch.Tensor]:
    """The fit with its first modes only, and where it is."""
    layout, psf = problem.layout, problem.model.psf
    sigma = layout.prior_sigma_nm
    fewer = replace(layout, nolls=layout.nolls[:kept], prior_sigma_nm=None if sigma is None else sigma[:kept])
    model = ImageModel(like(psf, psf.settings, fewer.nolls), problem.model.effects.effects)
    posed = problem.posed(model, fewer)
    return posed, problem.carried(x[:1], posed)


@dataclass(frozen=True)
class _Fit:
    """A fit with a suspect, and where it is."""

    problem: ImageFit
    x: torch.Tensor
    own: Sequence[int]  # columns of the suspect's parameters
    covariance: np.ndarray | None = None

    @classmethod
    def of(cls, problem: ImageFit, x: torch.Tensor, suspect: Suspect, values: np.ndarray) -> _Fit:
        """The fit `problem` at `x` with a `suspect` all of whose effect's parameters are at `values`."""
        psf, nolls, added = problem.model.psf, problem.layout.nolls, None
        effects = list(problem.model.effects.effects)
        if suspect.effect is not None:
            added = FixedEffect(suspect.effect.base, values, [p.name for p in suspect.effect.parameters])
            effects.append(added)
        path = psf if suspect.settings is None else like(psf, suspect.settings, nolls)
        model = ImageModel(path, effects)
        posed = problem.posed(model, replace(problem.layout, effects=model.effects.parameters))
        acting = zip(model.effects.labels, model.effects.effects, strict=True)
        own = [index for label, one in acting if one is added for index in model.effects.columns_of(label)]
        return cls(posed, problem.carried(x, posed), [len(nolls) + index for index in own])

    def further(self, steps: int) -> _Fit:
        """Return the fit some steps on, all parameters free; as it is where nothing can be computed."""
        try:
            solution = solve(self.problem, self.x, max_iterations=steps)
        except ValueError:
            return self
        if solution.status[0] == INVALID:
            return self
        return _Fit(self.problem, solution.values, self.own, solution.covariance[0].numpy())

    def with_modes(self, problem: ImageFit, x: torch.Tensor, suspect: Suspect) -> _Fit:
        """The fit of few modes as that of a `problem` at `x` with more, which are 0."""
        whole = _Fit.of(problem, x, suspect, self.x[0, list(self.own)].numpy())
        return replace(whole, x=self.problem.carried(self.x, whole.problem))

    @cached_property
    def chi2(self) -> float:
        """Infinite where the optics cannot be computed, as of pixels too large for the field."""
        try:
            return float(self.problem.reduced_chi2(self.x)[0]) * self.problem.freedom
        except ValueError:
            return math.inf

    def cause(self, suspect: Suspect, part: float) -> Cause:
        """The row of a `suspect` that explains a `part` of the misfit."""
        values, value, sigma = self.x[0, list(self.own)].numpy(), math.nan, math.nan
        if suspect.value is not None and self.covariance is not None:
            value, grown = suspect.value(values), max(1.0, self.chi2 / self.problem.freedom)
            errors = np.sqrt(grown * np.diag(self.covariance).clip(0))[list(self.own)]
            sigma = float(np.linalg.norm([suspect.value(values + step) - value for step in np.diag(errors)]))
        says = f"{suspect.phrase(values)} would explain {part:.0%} of the misfit: {suspect.key}"
        found = value, sigma, suspect.declared, suspect.unit, suspect.key, suspect.figure
        return Cause(suspect.name, says, part, *found)


def _tested(
    problem: ImageFit, x: torch.Tensor, null: NullModel, every: Iterable[Suspect]
) -> Iterator[tuple[float, Suspect, _Fit]]:
    """The fall of χ² that each suspect promises, and where its refit begins."""
    frozen = frozen_effects(problem.model.effects, x[0, problem.layout.effect_values])
    settings, image = problem.model.psf.settings, problem.predict(x)[0].cpu()
    for suspect in every:
        options: list[tuple[float, np.ndarray]] = []
        if suspect.effect is not None and suspect.settings is None:
            for one in suspect.effect.candidates(settings.window, settings.pixel_scale_mas):
                step = LinearEstimate.of(null, one, (derivatives(problem, x, frozen, one) * null.root).mT)
                whole = one.base is suspect.effect.base  # a scaled halo stands for all of it
                options.append((step.gain, one.all_values(step.sizes).numpy() if whole else suspect.begun[0]))
        for start in suspect.begun if suspect.optics else ():
            with suppress(ValueError):
                other = _Fit.of(problem, x, suspect, start)
                change = (other.problem.predict(other.x)[0].cpu() - image) * null.root
                along, left = float(change @ null.residual), float(null.norm2(change[:, None]))
                options.append((along**2 / left if along > 0 and left > 0 else 0.0, start))
        if options:
            gain, values = max(options, key=lambda one: one[0])
            yield gain, suspect, _Fit.of(problem, x, suspect, values)


def improbable_diversity(modes_nm: Mapping[int, float], conditions: Conditions) -> list[Cause]:
    """Return the diversity that would make estimated modes, Noll index to nm RMS, likelier than the declared.

    By the law of the instrument's NCPAs: where the diversity lies in another mode, or is not there, the fit
    takes it out of one mode and puts it into another.
    """
    declared = {noll: nm for noll, nm in conditions.diversity_nm.items() if nm}
    nolls = [noll for noll in modes_nm if noll in (*DIVERSE_NOLLS, *declared)]
    if conditions.ncpa_law is None or len(declared) != 1 or not nolls:
        return []
    ((mode, size),) = declared.items()
    sigma = NcpaPrior(conditions.ncpa_law, 1.0).sigma_nm(nolls).numpy()
    total = np.array([modes_nm[noll] + declared.get(noll, 0.0) for noll in nolls])

    def deviance(noll: int, nm: float) -> float:
        return float(np.sum(((total - nm * (np.array(nolls) == noll)) / sigma) ** 2))

    nm = size if abs(size) > SMALLEST_NM else 1e3 * size
    options = [
        (mode, 0.0),
        *((noll, one) for noll in nolls for one in (nm, -nm) if (noll, one) != (mode, size)),
    ]
    now, (least, noll, best) = deviance(mode, size), min((deviance(*one), *one) for one in options)
    if now - least < UNLIKELY:
        return []
    other = f"{abs(best):g} nm in Noll {noll}" if best else "none"
    was = f"{size:g} nm in Noll {mode}"
    says = f"a diversity of {other} instead of {was} would make the modes likely: diversity"
    found = (best, math.nan, size, "nm") if noll == mode else (float(noll), math.nan, float(mode), "Noll")
    return [Cause("diversity", says, 1 - least / now, *found, "diversity", MODES)]
