"""What a focus stage does wrong, from the defocus of a ramp's frames against its command.

Every error of the stage adds a known course to the introduced defocus, times its size, so that all choices
of a few errors are fitted linearly to the means of the visits and compared.

Estimates of one visit to an offset share the errors of the PSF model, so a visit's mean is known to no better
than `MODEL_NM`, however many frames it has.

The light path is decided before estimates are held against the focus stage. Two models with as many free
parameters each are fitted to the frames that a diagnosis may see; frames that it may not see decide between
them, each with its own tip, tilt, focus, flux and background.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
import torch

from irlos_pipe.diagnosis.null_model import gaussian_sigma, surely_exceeding
from irlos_pipe.diagnosis.records import Gap
from irlos_pipe.diagnosis.verdict import EFFECT, NONE, UNKNOWN
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.focus_stage import travel_direction
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.planes import RampEffect
from irlos_pipe.effects.public_values import measured
from irlos_pipe.estimate.ramp_fit import RampData, RampFit

PER_PARAMETER = 8.0  # fall of χ² that a size or an edge has to earn
CLOSE = 6.0  # χ² by which two indistinguishable names differ at most
WORST_CONDITION = 1e3  # of the normalised design; beyond it errors are degenerate on this ramp
SEEN_SIGMA = 5.2  # significance from which an error counts as seen
LEFT, LEFT_CHI2_NU = 0.1, 3.0  # part of χ², and χ²/ν, from which the fit leaves something unexplained
FAR_OFF_CHI2_NU = 10.0  # visits then miss by three times their errors, whatever part of χ² it is
Shapes = dict[RampEffect, np.ndarray]  # course of every error over the visits, whitened


@dataclass(frozen=True)
class RampName:
    """One error of the stage."""

    effect: RampEffect
    size: float
    sigma: float
    significance: float  # in Gaussian σ, trials counted
    explained: float  # part of the excess over noise
    alternatives: Sequence[RampEffect]  # errors whose courses are the same on this ramp

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def public(self) -> dict[str, float]:
        """Size, and the part of the ramp that is concerned, under public names."""
        return self.effect.describe(np.array([self.size])) | self.effect.part

    @property
    def public_sigma(self) -> dict[str, float]:
        """Standard error of the size under its public name."""
        return self.effect.describe(np.array([self.sigma]))

    @property
    def phrase(self) -> str:
        """The error with its size, as a sentence names it."""
        return self.effect.phrase(measured(self.public, self.public_sigma))

    @property
    def plausible(self) -> bool:
        """Whether a stage could err by so much."""
        low, high = self.effect.parameters[0].plausible
        return low <= self.size <= high


@dataclass(frozen=True)
class RampDiagnosis:
    """Errors of the stage in the order found."""

    verdict: str  # "none", "effect" or "unknown"
    names: Sequence[RampName]
    nearest: Sequence[RampName]  # what comes nearest, where the verdict is unknown
    chi2_nu: tuple[float, float]  # of the visits, before and after
    smallest: dict[str, dict[str, float]]  # public size of each error not found at which it would have been
    untestable: Sequence[str]

    def introduced_nm(self, commanded_nm: np.ndarray) -> np.ndarray:
        return commanded_nm + sum(
            (one.size * course(one.effect, commanded_nm) for one in self.names), np.zeros(len(commanded_nm))
        )


def diagnose_ramp(
    commanded_nm: np.ndarray, estimated_nm: np.ndarray, used: np.ndarray, sure: float = 5.0, most: int = 3
) -> RampDiagnosis:
    """Name the errors of the stage, one after the other, `most` at most, with `sure` σ each.

    The defocus, `commanded_nm` and `estimated_nm`, (frames,), is in order of recording; failed estimates are
    NaN. The fit may see the frames `used`, (frames,) of bool.
    """
    visits = Visits.of(commanded_nm, estimated_nm, used)
    data = (visits.mean_nm - visits.commanded_nm) / visits.sigma_nm
    shapes = {one: visits.course(one) for one in candidates(visits)}
    # Every choice of errors of different kinds, the best first: joint biases of several parts of a ramp could
    # follow any curve, and would explain everything.
    counts = range(min(most, len(data) - 2) + 1)
    choices = chain.from_iterable(combinations(shapes, count) for count in counts)
    different = (choice for choice in choices if len({one.name for one in choice}) == len(choice))
    every = (_Fit.of(data, shapes, choice) for choice in different)
    fits = sorted((fit for fit in every if fit is not None), key=lambda fit: fit.price)
    chosen = next(fit for fit in fits if all(_significance(fit, one, shapes) > sure for one in fit.effects))
    return _verdict(data, shapes, chosen, [_named(one, chosen, fits, data, shapes) for one in chosen.effects])


@dataclass(frozen=True)
class _Fit:
    """Linear fit of some errors to the visits."""

    effects: tuple[RampEffect, ...]
    sizes: np.ndarray  # (effects,)
    covariance: np.ndarray  # (effects, effects)
    chi2: float

    @classmethod
    def of(cls, data: np.ndarray, shapes: Shapes, effects: tuple[RampEffect, ...]) -> "_Fit | None":
        """The fit; None where the ramp does not determine it."""
        design = np.array([shapes[one] for one in effects]).reshape(len(effects), len(data)).T
        scale = np.linalg.norm(design, axis=0)
        if effects and (scale.min() == 0 or np.linalg.cond(design / scale) > WORST_CONDITION):
            return None
        covariance = np.linalg.inv(design.T @ design)
        sizes = covariance @ design.T @ data
        return cls(effects, sizes, covariance, float(np.sum((data - design @ sizes) ** 2)))

    @property
    def price(self) -> float:
        """χ² after a price per size and per edge of a part of the ramp."""
        return self.chi2 + PER_PARAMETER * (len(self.effects) + sum(len(one.part) for one in self.effects))


def _significance(fit: _Fit, effect: RampEffect, shapes: Shapes) -> float:
    """Significance of one error jointly with the others, in Gaussian σ."""
    at = fit.effects.index(effect)
    fall = fit.sizes[at] ** 2 / fit.covariance[at, at]
    return gaussian_sigma(float(fall), 1, np.inf, len(shapes))


def _named(effect: RampEffect, fit: _Fit, fits: Sequence[_Fit], data: np.ndarray, shapes: Shapes) -> RampName:
    """One of the chosen errors with its numbers."""
    at, excess = fit.effects.index(effect), float(data @ data) - len(data)
    kept = tuple(one for one in fit.effects if one is not effect)
    rest_chi2 = next(other for other in fits if other.effects == kept).chi2
    known = {one.name for one in kept}
    rivals: dict[str, RampEffect] = {}
    for other in fits:
        new = {one.name: one for one in other.effects if one.name not in known}
        alike = len(other.effects) == len(fit.effects) and other.price - fit.price < CLOSE
        if alike and len(new) == 1:
            rivals |= new
    scatter = max(fit.chi2 / max(len(data) - len(fit.effects), 1), 1.0)
    return RampName(
        effect,
        float(fit.sizes[at]),
        float(np.sqrt(scatter * fit.covariance[at, at])),
        _significance(fit, effect, shapes),
        float(min((rest_chi2 - fit.chi2) / max(excess, 1e-9), 1.0)),
        [rivals[name] for name in sorted(rivals.keys() - {effect.name})],
    )


def _verdict(data: np.ndarray, shapes: Shapes, fit: _Fit, names: list[RampName]) -> RampDiagnosis:
    after = fit.chi2 / max(len(data) - len(fit.effects), 1)
    unexplained = after > FAR_OFF_CHI2_NU or (after > LEFT_CHI2_NU and fit.chi2 > LEFT * float(data @ data))
    unexplained = unexplained or not all(one.plausible for one in names)
    seen = {one.name for one in names}
    surely = surely_exceeding(SEEN_SIGMA**2, 1) ** 0.5
    smallest = {
        one.name: one.describe(surely * np.sqrt(beside.covariance[-1:, -1]))
        for one in shapes
        if not one.part and one.name not in seen
        if (beside := _Fit.of(data, shapes, (*fit.effects, one))) is not None
    }
    verdict = UNKNOWN if unexplained else EFFECT if names else NONE
    ramp_effects = {name for name, kind in CATALOGUE.items() if issubclass(kind, RampEffect)}
    untestable = sorted(ramp_effects - seen - set(smallest))
    known, nearest = ([], names) if unexplained else (names, [])
    chi2_nu = (float(data @ data) / len(data), after)
    return RampDiagnosis(verdict, known, nearest, chi2_nu, smallest, untestable)


MODEL_NM = 4.0  # error of a visit's mean that no number of frames lowers


@dataclass(frozen=True)
class Visits:
    """Frames at one offset in a row."""

    all_nm: np.ndarray  # (all visits,), offsets in order of recording
    # (all visits,), those with estimates; where the stage turns, the first is left out, as it is not known
    # from where its offset was reached.
    good: np.ndarray
    mean_nm: np.ndarray  # (good visits,)
    sigma_nm: np.ndarray  # (good visits,)

    @classmethod
    def of(cls, commanded_nm: np.ndarray, estimated_nm: np.ndarray, used: np.ndarray) -> "Visits":
        """Means of the used frames, see `diagnose_ramp`; ValueError with fewer than three visits."""
        starts = np.flatnonzero(np.diff(commanded_nm, prepend=np.nan) != 0)
        offsets = commanded_nm[starts]
        groups = [g[np.isfinite(g)] for g in np.split(np.where(used, estimated_nm, np.nan), starts[1:])]
        unknown = (travel_direction(offsets) == 0) & _turns(offsets)
        good = np.array([len(group) > 0 for group in groups]) & ~unknown
        if good.sum() < 3:
            raise ValueError("a diagnosis of a ramp needs three visits to offsets, with estimates")
        kept = [groups[i] for i in np.flatnonzero(good)]
        errors = [np.std(g, ddof=1) / np.sqrt(len(g)) if len(g) > 1 else 0.0 for g in kept]
        return cls(offsets, good, np.array([np.mean(g) for g in kept]), np.hypot(errors, MODEL_NM))

    @property
    def commanded_nm(self) -> np.ndarray:
        return self.all_nm[self.good]

    def course(self, effect: RampEffect) -> np.ndarray:
        """What a unit of the effect adds, over its standard error, (good visits,)."""
        return course(effect, self.all_nm)[self.good] / self.sigma_nm


def _turns(offsets_nm: np.ndarray) -> bool:
    """Whether the stage moves both ways."""
    return len(set(travel_direction(offsets_nm)) - {0}) > 1


def course(effect: RampEffect, commanded_nm: np.ndarray) -> np.ndarray:
    """What a unit of `effect` adds to the introduced defocus at the offsets `commanded_nm`, (offsets,)."""
    zero, one = torch.zeros(len(commanded_nm), dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    return effect.apply(one, zero, np.asarray(commanded_nm, float)).numpy()


def candidates(visits: Visits) -> list[RampEffect]:
    """All errors of the stage, those of a part of the ramp included."""
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, RampEffect)]
    offsets_nm = np.unique(visits.commanded_nm)
    return [
        *(one for kind in kinds for one in kind.on_whole_ramp(turns=_turns(visits.all_nm))),
        *(one for kind in kinds for one in kind.on_parts(offsets_nm)),
    ]


STEPS = 3  # Gauss–Newton steps of what belongs to single frames, which is nearly linear
FRAMES_AT_ONCE = 8  # bounds the memory of the derivatives


def ramp_gap(
    model: ImageModel,
    data: RampData,
    start_nm: torch.Tensor,
    before_nm: np.ndarray,
    after_nm: np.ndarray,
    held_out: np.ndarray,
) -> Gap:
    """``Σ|measured − predicted| / Σ measured`` of the mean images per offset of the held-out frames.

    Tip, tilt, flux and background of every frame are refitted. The defocus is `before_nm`, as commanded, and
    `after_nm`, as corrected, (frames,); other modes are estimates, `start_nm`, (frames, modes). The `model`
    has Noll 2, 3 and 4 among its modes and no free effects.
    """
    chosen = torch.as_tensor(held_out)
    images, offsets = data.images_e.double()[chosen], data.introduced_nm[held_out]
    good = data.good
    predicted = []
    for defocus_nm in (before_nm, after_nm):
        modes_nm = start_nm.clone()
        modes_nm[:, model.psf.nolls.index(4)] = torch.as_tensor(defocus_nm)
        pieces = (one.split(FRAMES_AT_ONCE) for one in (images, modes_nm[chosen]))
        predicted.append(torch.cat([_refitted(model, data, *piece) for piece in zip(*pieces, strict=True)]))
    groups = [torch.as_tensor(offsets == value) for value in np.unique(offsets)]
    total = sum(float(images[group].mean(0)[good].sum()) for group in groups)
    before, after = (
        sum(float((images[g].mean(0) - model_e[g].mean(0))[good].abs().sum()) for g in groups) / total
        for model_e in predicted
    )
    noise = [
        _noise_e(data, torch.as_tensor(data.introduced_nm == value), int((offsets == value).sum()))
        for value in np.unique(offsets)
    ]
    return Gap(before, after, sum(noise) / total)


def _refitted(
    model: ImageModel, data: RampData, images: torch.Tensor, modes_nm: torch.Tensor
) -> torch.Tensor:
    """Gauss–Newton steps of tip, tilt, flux and background."""
    root = torch.where(data.good, data.noise.variance_e2(images) ** -0.5, 0.0).flatten(1)
    own = [model.psf.nolls.index(2), model.psf.nolls.index(3), -2, -1]
    modes, light = modes_nm.clone(), torch.stack([images.sum((1, 2)), torch.zeros(len(images))], dim=1)
    for _ in range(STEPS):
        found = model.predict_and_jacobian(modes, light[:, 0], light[:, 1], held=True)
        image, columns = (one.cpu() for one in found)
        design = columns[:, own].double().flatten(2).mT * root[:, :, None]
        misfit = (images.flatten(1) - image.flatten(1)) * root
        step = torch.linalg.lstsq(design, misfit[:, :, None]).solution[..., 0]
        modes[:, own[:2]] += step[:, :2]
        light = light + step[:, 2:]
    return model.predict(modes, light[:, 0], light[:, 1]).cpu()


def _noise_e(data: RampData, at_offset: torch.Tensor, averaged: int) -> float:
    """What noise leaves of a mean of `averaged` frames, from the scatter of all frames at the offset.

    A normal deviate is √(2/π) σ away from zero on average.
    """
    images = data.images_e.double()[at_offset]
    photons = data.noise.scatter_e2(images.mean(0))
    scatter = images.var(0, correction=1) if len(images) > 1 else photons
    sigma = (torch.maximum(photons, scatter) / averaged + data.noise.shared_e2).sqrt()
    return float(np.sqrt(2 / np.pi) * sigma[data.good].sum())


COMPLETE_CHI2_NU = 1.2  # of images that a model explains; simulated ones have 1.0 within 0.1


@dataclass(frozen=True)
class Comparison:
    """Two fits of a ramp on the frames held out."""

    # Mean of the frames, with the model as it was and with the candidate.
    chi2_nu: tuple[float, float]
    better: float  # part of the frames that the candidate fits better
    # Root of the fall of χ² per unit of the χ²/ν that the candidate leaves, which stands for the errors of
    # both models.
    significance: float
    gap: tuple[float, float]  # ``Σ|measured − predicted| / Σ measured``

    @property
    def complete(self) -> bool:
        """Return whether it leaves little but noise; else estimates of the focus share its errors."""
        return self.chi2_nu[1] < COMPLETE_CHI2_NU

    def favours(self, sure: float) -> bool:
        """Return whether the candidate is `sure` σ better, and so in most of the frames."""
        return self.significance > sure and self.better > 0.5


@dataclass(frozen=True)
class LightPathName:
    """An effect on the light path that the images prefer."""

    effect: Effect
    values: Sequence[float]
    comparison: Comparison

    @property
    def public(self) -> dict[str, float]:
        """Its size under public names."""
        return self.effect.describe(np.array(self.values))

    @property
    def phrase(self) -> str:
        """The effect with its size, as a sentence names it."""
        return self.effect.phrase(self.public)


def compare(data: RampData, plain: RampFit, candidate: RampFit, held_out: np.ndarray) -> Comparison:
    """Compare two fits of the ramp `data` on the frames `held_out`, (frames,) of bool."""
    which = torch.as_tensor(held_out)
    before, after = (fit.result.chi2_nu[which].double() for fit in (plain, candidate))
    good = torch.isfinite(before) & torch.isfinite(after)
    before, after = before[good], after[good]
    pixels = int(data.good.sum())
    fall = float((before - after).sum()) * pixels / max(float(after.mean()), 1.0)
    gaps = [_gap(data, fit, which) for fit in (plain, candidate)]
    return Comparison(
        (float(before.mean()), float(after.mean())),
        float((after < before).double().mean()),
        float(np.sign(fall) * np.sqrt(abs(fall))),
        (gaps[0], gaps[1]),
    )


def _gap(data: RampData, fit: RampFit, which: torch.Tensor) -> float:
    images = data.images_e[which].double()[:, data.good]
    model = fit.result.model_e[which].double().reshape(len(images), *data.good.shape)[:, data.good]
    return float((images - model).abs().sum() / images.sum())
