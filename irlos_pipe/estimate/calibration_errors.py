"""Errors of a calibration: from the scatter of the frames, and what the model misfits.

A closed loop leaves less of slow changes than of fast ones, tomography more. Only the slow ones average into
the mean: where the slowest changes of Noll 4–30 together have another power than the scatter and its
autocorrelation tell, beyond chance, variances change by as much.

The noise of a dark is the same in all frames, which therefore do not show it: with its variance v and the
gain ``G = C Jᵀ W`` of the fit, ``v G Gᵀ`` is added.

Of a mean image what the model misfits beyond noise is an error m of the model in proportion to the light,
with a correlation S over `CORRELATED` λ/D. With the smoothed light L on the diagonal, ``R = 1 − J G`` and n,
the variance by frames of what is left of the mean image, scaled to the nominal χ², what is left, r, has

    ⟨m mᵀ⟩ = s² L S L,    ⟨r²⟩ = n + s² diag(R L S L Rᵀ),    cov = scatter + s² G L S L Gᵀ

The size s is the likeliest one, as if pixels were independent: those in which such an error stands out tell
it. It is no noise that further frames would average out.

Too few frames say little of their scatter: their errors are those of the noise model, and
where they scatter beyond it, as behind an AO system, those of the scatter besides, widened as Student's t
asks for three standard deviations.

Of one image or a few, what the model misfits beyond noise, an error of its own or speckles that did
not average out, is counted as further noise of the same kind: variances grow by χ²/ν. A prior does not
become weaker by that, so with the inverse Hessian C, its part P from the prior and the factor s,
``cov = C (s (C⁻¹ - P) + P) C``.

What χ²/ν of a mean image is nominal, that of a model which lacks nothing, follows from the frames as well.
The weights of a mean image count every pixel's scatter by itself. Scatter that pixels share, as that of
speckles, is partly followed by the modes, so that χ²/ν of a right model is 1 for photon noise and less for
speckles, by an amount that depends on brightness, seeing and number of frames. The frames tell it. With the
whitened deviations ``d_i`` of N frames from their mean, and the matrix R that takes the part out which the
fitted parameters would follow,

    E[χ²] = τ Σ |R d_i|² / (N (N − 1)),     Var[χ²] = 2 τ² tr(Σ²) / N²,

where Σ is the covariance of ``R d`` and τ the autocorrelation time of the frames. An unbiased estimate of
tr(Σ²) is the mean of ``(R d_i · R d_j)²`` over pairs (Bai & Saranadasa 1996, Statistica Sinica 6, 311).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from scipy.special import ndtr, stdtrit

from irlos_pipe.conventions.modes import REPORTED_NOLLS, TIP_TILT
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.estimate.cube import LEAST_FRAMES, Frames, covariance_of_mean, local_mean
from irlos_pipe.estimate.image_fit import Fit, ImageFit, whole_wavefront
from irlos_pipe.frames.recording import blocks
from irlos_pipe.numerics.parallel import joined_map
from irlos_pipe.numerics.solver import INVALID
from irlos_pipe.optics.image_quality import power_spectrum

ErrorsFrom = Literal["frames", "few_frames", "noise"]
BY_CHANCE = 5.0  # standard deviations that are chance, of scatter, of scores and of χ²/ν
KEPT_SIGMA = 3.0  # standard deviations at which the widened errors keep their level of confidence


def errors_of(
    frames: Frames, fit: Fit, frames_nm: np.ndarray, chi2_nu: float, nominal: NominalChi2
) -> tuple[np.ndarray, ErrorsFrom]:
    """Return the covariance of the modes [nm²], and where it comes from.

    The estimates of single frames, `frames_nm` (frames, modes), are NaN where a fit failed. Where these are
    fitted, errors grow by the root of what χ²/ν of the mean image is over its nominal value.
    """
    used = frames_nm[np.isfinite(frames_nm).all(1)]
    if frames.show_scatter and fit.problem.images.shape[:2] != (1, 1):
        return max(1.0, chi2_nu / nominal.value) * covariance_of_mean(used), "frames"
    if frames.show_scatter:
        scatter = slow_part(used[:, len(TIP_TILT) : len(REPORTED_NOLLS)]) * covariance_of_mean(used)
        of_shared, of_model = _systematic_nm2(frames, fit, nominal)
        return scatter + of_shared + of_model, "frames"
    covariance = covariance_from_noise(fit)
    if not _scatter_beyond(used, covariance):
        return covariance, "noise"
    return covariance + widening(len(used) - 1) ** 2 * np.cov(used, rowvar=False) / len(used), "few_frames"


def slow_part(series: np.ndarray) -> float:
    """Return the power of the slowest changes of a `series` (frames, modes) over what its scatter tells.

    That is N² times the variance of the mean of N frames, `covariance_of_mean`. One where it is so by chance.
    """
    power = np.abs(np.fft.rfft(series - series.mean(axis=0), axis=0)[1 : SLOWEST + 1]) ** 2
    told = covariance_of_mean(series)
    if not (np.trace(told) > 0 and power.any()):
        return 1.0
    slow = float(power.sum() / (SLOWEST * len(series) ** 2 * np.trace(told)))
    return slow if abs(np.log(slow)) * np.trace(told) > DISTINCT * np.sqrt((told**2).sum() / SLOWEST) else 1.0


def _systematic_nm2(frames: Frames, fit: Fit, nominal: NominalChi2) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of the modes [nm²] by what all frames share, (modes, modes) each.

    These are the noise of the dark, and the error of the model.
    """
    problem, x, settings = fit.problem, fit.x, fit.problem.model.psf.settings
    model_e, jacobian = (one[0].double().cpu() for one in problem.predict_and_jacobian(x))
    covariance, weight = fit.solution.covariance[0], problem.root_weight[0].double().mean(0).cpu() ** 2
    weighted, gain = jacobian * weight, whole_wavefront(problem, x[0])[1] @ covariance
    of_shared = frames.noise.shared_e2 * (gain @ (weighted @ weighted.mT) @ gain.mT).numpy()
    seen = weight > 0
    light = local_mean(frames.mean_e, frames.good.double()).clamp_min(0).flatten() * seen
    rows, columns = (
        torch.as_tensor(np.sinc(np.subtract.outer(i, i) / (CORRELATED * settings.resolution_px)) ** 2)
        for i in map(np.arange, frames.good.shape)
    )
    felt = weighted * light
    alike = (rows @ felt.reshape(-1, *frames.good.shape) @ columns).flatten(1)  # times S
    products, moved = felt @ alike.mT, covariance @ jacobian
    left = light**2 - 2 * (moved * alike * light).sum(0) + (moved * (products @ moved)).sum(0)
    own = torch.where(seen, frames.sample_e - frames.mean_e.flatten(), 0.0)
    noise = ((own - own @ weighted.mT @ moved) ** 2 * weight).mean(0).reshape(frames.good.shape)
    noise = local_mean(noise, seen.double().reshape(frames.good.shape)).flatten() / weight
    shared = frames.noise.shared_e2 * frames.root[seen] ** 2  # which the frames do not show
    shown = max(nominal.value * problem.freedom - float(shared.sum()), 0.0)
    noise = frames.noise.shared_e2 + noise * shown / (noise * frames.root**2)[seen].sum()
    squares = (frames.mean_e.flatten() - model_e.flatten()) ** 2
    size = likeliest_size(squares[seen], noise[seen], left[seen].clamp_min(0))
    return of_shared, (size * gain @ products @ gain.mT).numpy()


def likeliest_size(squares: torch.Tensor, noise: torch.Tensor, shape: torch.Tensor) -> float:
    """Return the s² of the likeliest variances ``noise + s² shape`` of Gaussian values with these `squares`.

    All are (values,); s² is 0, or from 1e-12 to 1 in steps of 10 %.
    """
    sizes = [0.0, *np.geomspace(1e-12, 1.0, 291)]
    variances = (noise + size * shape for size in sizes)
    return sizes[int(np.argmin([float((one.log() + squares / one).sum()) for one in variances]))]


def _scatter_beyond(used: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether estimates scatter by more than the `covariance` of their mean says, over all modes together."""
    count, modes = used.shape
    if count < 2:
        return False
    ratio = float(np.mean(used.var(axis=0, ddof=1) / count / np.diag(covariance)))
    return ratio > 1 + BY_CHANCE * np.sqrt(2 / (modes * (count - 1)))


def errors_of_mean(estimates_nm: np.ndarray, covariances_nm2: Sequence[np.ndarray]) -> np.ndarray:
    """Return the covariance of the mean of estimates (cubes, modes) [nm²].

    Where they scatter by more than their errors, their scatter is added: to those of tip and tilt, which the
    pointing changes, and to those of the shapes, each by itself.
    """
    count = len(estimates_nm)
    covariance = np.sum(covariances_nm2, axis=0) / count**2
    for own in (slice(len(TIP_TILT)), slice(len(TIP_TILT), None)):
        some = estimates_nm[:, own]
        if _scatter_beyond(some, covariance[own, own]):
            covariance[own, own] += np.cov(some, rowvar=False) / count
    return covariance


def widening(freedom: float) -> float:
    """Return the factor on a standard error from scatter with so few degrees of `freedom`."""
    return float(stdtrit(freedom, ndtr(KEPT_SIGMA))) / KEPT_SIGMA


SLOWEST, DISTINCT = 2, 2.0  # frequencies over the whole series; standard deviations that are chance
CORRELATED = 2.3  # λ/D to the first zero of the correlation of the model's error: an Airy core
# χ²/ν over nominal up to which an AO residual of another shape than the model's is an error that counts as
# others do: behind other AO systems it leaves 1.3 to 3.3, of wrong instruments one in a hundred is below.
OTHER_RESIDUAL = 2.0
# Part of χ²/ν that may be more by errors of the discretisation, of which complete models leave up to 1.14,
# and less by the noise of the dark, which the frames show to a fifth of their scatter.
KNOWN_TO = 0.15
LONGEST = 512  # frames of which all pairs are compared; of more, runs of neighbours are averaged


@dataclass(frozen=True)
class NominalChi2:
    """Expected χ²/ν of a model that lacks nothing, and its standard deviation from cube to cube."""

    value: float
    sigma: float

    @property
    def least(self) -> float:
        """Below this χ²/ν is neither by chance nor by the error of the noise that all frames share."""
        return max(0.0, (1 - KNOWN_TO) * self.value - BY_CHANCE * self.sigma)

    @property
    def most(self) -> float:
        """Above this χ²/ν is neither by chance nor by errors of the discretisation."""
        return (1 + KNOWN_TO) * self.value + BY_CHANCE * self.sigma

    @property
    def most_behind_ao(self) -> float:
        """Above this it is not by an AO residual of another shape either, which the errors count."""
        return max(self.most, OTHER_RESIDUAL * self.value + BY_CHANCE * self.sigma)

    def excess(self, chi2_nu: float) -> float:
        """Return what a χ²/ν has more than this one and chance; 0 if nothing."""
        return max(0.0, chi2_nu - self.value - DISTINCT * self.sigma)


@dataclass(frozen=True)
class Part:
    """A mean image among those that are fitted together."""

    frames: Frames  # of fewer than `LEAST_FRAMES` the noise model takes the place of the scatter
    jacobian: torch.Tensor  # (its parameters, pixels), of the model image [e- per unit of the parameter]
    columns: Sequence[int]  # (its parameters,), where they stand among the parameters of all parts

    @cached_property
    def root(self) -> torch.Tensor:
        """See `Frames.root`."""
        return self.frames.root

    @cached_property
    def whitened(self) -> torch.Tensor:
        """Derivatives in units of the noise, (pixels, its parameters)."""
        return (self.jacobian.double().cpu() * self.root).mT

    @property
    def used(self) -> int:
        """Number of pixels."""
        return int((self.root > 0).sum())

    def products(self, gain: torch.Tensor, data: torch.Tensor) -> torch.Tensor:
        """Return products of what deviations of the frames leave in all images, (frames, frames).

        Whitened deviations d less what the parameters of all images follow: ``R d · R d'``.
        """
        images, mean = self.frames.images_e.flatten(1), self.frames.mean_e.flatten()
        runs = torch.arange(len(images)).tensor_split(min(len(images), LONGEST))
        root, there, columns = self.root, self.jacobian.device, [*self.columns]

        def deviations(block: slice) -> tuple[torch.Tensor]:
            some = torch.stack([images[run].mean(0, dtype=torch.float64) for run in runs[block]])
            return (torch.where(root > 0, (some - mean) * root, 0.0),)

        (whitened,) = joined_map(deviations, blocks(len(runs)), len(runs))
        whitened, own, gain, data = (one.to(there) for one in (whitened, self.whitened, gain, data))
        felt = whitened @ own
        moved = felt @ gain[columns]

        def rows(block: slice) -> tuple[torch.Tensor]:
            rest = whitened[block] @ whitened.mT - 2 * moved[block][:, columns] @ felt.mT
            return (rest + moved[block] @ data @ moved.mT,)

        return joined_map(rows, blocks(len(runs)), len(runs))[0].cpu()


def nominal_chi2(parts: Sequence[Part], precision: torch.Tensor) -> NominalChi2:
    """Return the χ²/ν of mean images fitted together about a model that lacks nothing.

    The prior has a `precision` (parameters of all,), 0 where there is none.
    """
    data = torch.zeros(len(precision), len(precision), dtype=torch.float64)
    for one in parts:
        columns = torch.tensor([*one.columns])
        data[columns[:, None], columns] += one.whitened.mT @ one.whitened
    gain = torch.linalg.pinv(data + torch.diag(precision.double()), hermitian=True)
    used = sum(one.used for one in parts)
    freedom = max(used - len(precision), 1)
    followed = gain @ data
    white = used - 2 * float(torch.trace(followed)) + float((followed * followed.mT).sum())
    expected, variance = 0.0, 0.0
    for one in parts:
        share = white * one.used / used
        if len(one.frames.images_e) < LEAST_FRAMES:
            expected, variance = expected + share, variance + 2 * share
            continue
        own, deviation = _of_scatter(one.products(gain, data))
        shared = float((one.frames.noise.shared_e2 * one.root**2).sum()) * share / one.used
        expected, variance = expected + own + shared, variance + deviation**2
    return NominalChi2(expected / freedom, float(np.sqrt(variance)) / freedom)


def nominal_of(frames: Frames, problem: ImageFit, values: torch.Tensor) -> NominalChi2:
    """Return that of the mean of `frames` at the place `values`, (1, parameters), of its `problem`."""
    _, jacobian = problem.predict_and_jacobian(values)
    return nominal_chi2([Part(frames, jacobian[0], range(jacobian.shape[1]))], problem.prior_precision[0])


def nominal_power(
    frames: Frames, problem: ImageFit, values: torch.Tensor, nominal: NominalChi2
) -> np.ndarray | None:
    """Return the power spectrum that a complete model leaves of the mean image; None of too few frames.

    It is that of ``R d_i``, averaged over frames and scaled to the `nominal` χ²; other arguments are those of
    `nominal_of`. See `image_quality.power_spectrum`.
    """
    if len(frames.images_e) < LEAST_FRAMES:
        return None
    _, jacobian = problem.predict_and_jacobian(values)
    one = Part(frames, jacobian[0], range(jacobian.shape[1]))
    precision = torch.diag(problem.prior_precision[0].double().cpu())
    gain = torch.linalg.pinv(one.whitened.mT @ one.whitened + precision, hermitian=True)
    own = torch.where(one.root > 0, (frames.sample_e - frames.mean_e.flatten()) * one.root, 0.0)
    left = torch.where(one.root > 0, own - own @ one.whitened @ gain @ one.whitened.mT, torch.nan).numpy()
    resolution_px = problem.model.psf.settings.resolution_px
    spectra = [power_spectrum(each.reshape(frames.good.shape), resolution_px).value for each in left]
    chi2 = nominal.value * max(one.used - jacobian.shape[1], 1)
    return np.mean(spectra, axis=0) * chi2 / float(np.nansum(left**2) / len(left))


def _of_scatter(products: torch.Tensor) -> tuple[float, float]:
    """Expected χ² of the mean of frames with these products, and its standard deviation."""
    count = len(products)
    squares = products.diagonal()
    time = _autocorrelation_time(products)
    expected = time * float(squares.sum()) / (count * (count - 1))
    pairs = float(products.square().sum() - squares.square().sum()) / (count * (count - 1))
    of_one = time / count * float(squares.std()) / np.sqrt(count)
    return expected, float(np.hypot(np.sqrt(2 * pairs) * time / count, of_one))


def _autocorrelation_time(products: torch.Tensor) -> float:
    """Integrated autocorrelation time of vectors from their products, as `cube.autocorrelation_time`."""
    count = len(products)
    if count < 8:
        return 1.0
    total = float(products.diagonal().mean())
    rho = [float(products.diagonal(lag).mean()) / total for lag in range(1, count // 4 * 2 + 1)]
    time = 1.0
    for first, second in zip(rho[::2], rho[1::2], strict=True):
        if first + second <= 0:
            break
        time += 2 * (first + second)
    return time


def covariance_from_noise(fit: Fit) -> np.ndarray:
    """Return the covariance of the whole static wavefront, the mean over the fits [nm²], (modes, modes).

    The weights of the `fit` are those of the noise.
    """
    problem, solution = fit.problem, fit.solution
    usable = [member for member, status in enumerate(solution.status) if status != INVALID]
    values, covariance = solution.values[usable], solution.covariance[usable]
    misfit = problem.members(torch.tensor(usable)).reduced_chi2(values).clamp_min(1.0)[:, None, None]
    precision = torch.diag_embed(problem.prior_precision[usable])
    scaled = misfit * covariance - (misfit - 1) * (covariance @ precision @ covariance)
    _, read = whole_wavefront(problem, values[0])
    return (read @ (scaled.mean(0) / len(usable)) @ read.mT).numpy()


def effect_errors(frames: Frames, fit: Fit, misfit: float) -> dict[str, dict[str, Any]]:
    """Return the errors of the public values of the effects, by label: from the scatter of the frames.

    Of too few frames from the noise model. Both grow by the `misfit`, see `errors_of`. The `fit` of these
    frames has one member.
    """
    problem, layout, x = fit.problem, fit.problem.layout, fit.x
    if not problem.model.effects.parameters:
        return {}
    covariance = fit.solution.covariance[0][layout.effect_values]
    if frames.show_scatter:
        _, jacobian = problem.predict_and_jacobian(x)
        weight = problem.root_weight[0].double().mean(0) ** 2
        gain = covariance @ (jacobian[0].double() * weight).cpu()
        of_effects = covariance_of_mean(frames.responses(gain).numpy())
    else:
        of_effects = covariance[:, layout.effect_values].numpy()
    return public_errors(problem.model.effects, x[0, layout.effect_values], max(1.0, misfit) * of_effects)


def public_errors(effects: EffectSet, values: torch.Tensor, covariance: np.ndarray) -> dict[str, dict]:
    """Return the errors of the public values of `effects`, by label, those without free parameters left out.

    All free parameters are at `values` (parameters,), with a `covariance` (parameters, parameters).
    """
    found = {}
    for label, effect in zip(effects.labels, effects.effects, strict=True):
        columns = effects.columns_of(label)
        if columns:
            every = effect.all_values(values[columns]).numpy()
            full = np.zeros((len(every), len(every)))
            full[np.ix_(effect.free, effect.free)] = covariance[np.ix_(columns, columns)]
            found[label] = public_sigma(effect.base, every, full)
    return found
