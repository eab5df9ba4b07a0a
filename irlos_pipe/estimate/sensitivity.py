"""How faint LIFT goes: the frames of a ramp, dimmed, with the noise that dimming took away put back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.units import MEDIAN_OF_NORMAL, ONE_SIGMA
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.lift import REACH_NM, NearModel, in_pieces, lift, near
from irlos_pipe.estimate.ramp_fit import RampData, RampFit
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.parallel import at_once, ordered_map, process_map
from irlos_pipe.numerics.solver import scaled_inverse

IMAGES_AT_ONCE = 1024  # images that are dimmed and estimated together, at least those of one magnitude


@dataclass(frozen=True)
class Curve:
    """Error of defocus against magnitude for one configuration; arrays (magnitudes,)."""

    nolls: tuple[int, ...]
    mag_j: np.ndarray
    # Of |estimated - introduced| over frames and realisations that did not fail.
    median_abs_error_nm: np.ndarray
    p16_nm: np.ndarray
    p84_nm: np.ndarray
    crb_nm: np.ndarray  # median over the frames of the Cramér–Rao bound, 1σ
    failures: np.ndarray  # estimates that did not converge or left the plausible range
    trials: int  # estimates per magnitude
    limit_mag: float  # faintest magnitude that meets the criterion; NaN if none does
    abs_error_nm: np.ndarray  # (magnitudes, trials), |estimated - introduced|, NaN where it failed
    one_read_crb_nm: np.ndarray  # the same as `crb_nm`, of exposures of one read without sky

    def bound_mag(self, criterion: Criterion) -> float:
        """Return the limiting magnitude of an efficient estimate from exposures of one read without sky."""
        never = np.zeros(len(self.mag_j))
        return limiting_magnitude(self.mag_j, MEDIAN_OF_NORMAL * self.one_read_crb_nm, never, criterion)


@dataclass(frozen=True)
class Configuration:
    """How frames are estimated for one curve."""

    model: ImageModel
    signal_e: torch.Tensor  # (frames, rows, columns): the frames without noise
    start_nm: torch.Tensor  # (frames, modes)
    # (frames, modes): estimates from the frames as they are, which make a scan quicker. Estimates stay the
    # same, except that a fit for which several minima compete may end in another.
    near_nm: torch.Tensor | None = None

    @classmethod
    def of(cls, fit: RampFit) -> Configuration:
        """Return that of the `fit` of the frames as they are."""
        return cls(fit.model, fit.result.model_e, fit.start_nm, fit.result.zernike_nm)

    @property
    def near(self) -> NearModel | None:
        return None if self.near_nm is None else near(self.model, self.near_nm)


@dataclass(frozen=True)
class Criterion:
    """What "limiting magnitude" means."""

    median_nm: float  # the median |error| may not exceed this [nm RMS]
    failure_fraction: float  # nor may more than this part of the estimates fail
    # an estimate further than this from the introduced defocus counts as failed
    implausible_nm: float = REACH_NM


def dim(
    images_e: torch.Tensor,
    signal_e: torch.Tensor,
    factor: float,
    noise: NoiseModel,
    generator: torch.Generator,
    faint: NoiseModel | None = None,
) -> torch.Tensor:
    """Return frames as a star dimmer by `factor` would have given them.

    Scaling by s < 1 scales the noise variance by s²; what is missing to the variance of a frame of
    the scaled flux is ``(F' s - F s²) signal + floor' - s² floor``, F' and floor' being those of the faint
    frame, drawn as an excess-scaled Poisson and a normal variate.

    Measured frames and their noise-free model `signal_e` are (frames, rows, columns). The `noise` is that of
    the frames, and unless another one is given, that of the `faint` ones; where these have less than scaling
    leaves, nothing is taken away. Frames cannot be made brighter honestly: no `factor` exceeds 1.
    """
    faint = faint or noise
    gain = faint.excess_noise_factor
    lacking = max(0.0, gain * factor - noise.excess_noise_factor * factor**2)
    photons = signal_e.double().clamp_min(0) * lacking / gain**2
    shot = gain * (torch.poisson(photons, generator=generator) - photons)
    floor = torch.randn(images_e.shape, generator=generator, dtype=torch.float64)
    missing = np.sqrt(max(0.0, faint.floor_e2 - factor**2 * noise.floor_e2))
    return images_e.double() * factor + shot + missing * floor


def scan(
    configurations: Sequence[Configuration],
    data: RampData,
    mag_j: float,
    magnitudes: np.ndarray,
    realisations: int,
    criterion: Criterion,
    seed: int,
    *,
    faint: NoiseModel | None = None,
    one_read: NoiseModel | None = None,
    report: Callable[[int], Any] = lambda count: None,
) -> list[Curve]:
    """Estimate the error of defocus over a range of magnitudes, for every one of some configurations.

    The measured frames `data` are of a star of magnitude `mag_j`, and no brighter are the `magnitudes`, at
    which every frame has so many `realisations`. The noise of the dimmed frames, `faint`, and that of
    exposures of one read without sky, `one_read`, for comparison, are by default those of the measured ones.
    `report` gets the number of estimates that were finished, for a progress bar.
    """
    faint, one_read = faint or data.noise, one_read or data.noise
    factors = np.minimum(1.0, 10 ** (-0.4 * (np.asarray(magnitudes) - mag_j)))
    frames = len(data.images_e)
    close_to = [one.near for one in configurations]

    def dimmed(signal_e: torch.Tensor, index: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed + 7919 * int(index))
        arguments = signal_e, factors[index], data.noise, generator, faint
        drawn = [dim(data.images_e, *arguments).to(data.images_e.dtype) for _ in range(realisations)]
        return torch.stack(drawn, dim=1)

    def pieces(number: int, group: np.ndarray) -> list[tuple[int, torch.Tensor, torch.Tensor]]:
        """Images at some magnitudes, in pieces with the numbers of the configuration and of their frames."""
        one = configurations[number]
        images_e = torch.cat(ordered_map(lambda index: dimmed(one.signal_e, index), group), dim=1)
        own = torch.arange(frames).repeat_interleave(images_e.shape[1])
        split = in_pieces(one.model, close_to[number], own, images_e.flatten(0, 1))
        return [(number, *piece) for piece in split]

    def errors_of(piece: tuple[int, torch.Tensor, torch.Tensor]) -> np.ndarray:
        number, own, images_e = piece
        model, close = configurations[number].model, close_to[number]
        close = close and close.of(own)
        options, start = LiftOptions("model"), configurations[number].start_nm[own]
        result = lift(model, images_e, data.good, faint, start, options, near=close, beyond=False)
        error = np.abs(result.mode(4)[0].numpy() - data.introduced_nm[own.numpy()])
        lost = ~result.solution.converged | (close or model).at_limit(result.zernike_nm)
        failed = lost.numpy() | ~(error < criterion.implausible_nm)
        return np.where(failed, np.nan, error)

    def errors_nm(group: np.ndarray) -> np.ndarray:
        """Errors (configurations, magnitudes, trials) of some magnitudes."""
        every = [piece for number in range(len(configurations)) for piece in pieces(number, group)]
        errors = np.concatenate(process_map(errors_of, every, lambda piece: report(len(piece[1]))))
        by_frame = errors.reshape(len(configurations), frames, len(group), realisations)
        return by_frame.swapaxes(1, 2).reshape(len(configurations), len(group), -1)

    most = at_once(IMAGES_AT_ONCE, configurations[0].model.psf.device)
    groups = min(len(factors), -(-len(factors) * frames * realisations // most))
    split = np.array_split(np.arange(len(factors)), groups)
    errors = np.concatenate([errors_nm(group) for group in split], axis=1)

    def curve(one: Configuration, abs_error_nm: np.ndarray) -> Curve:
        focus, true = one.model.psf.nolls.index(4), one.start_nm.clone()
        true[:, focus] = torch.as_tensor(data.introduced_nm)
        bounds = _bounds_nm(one.model, true, one.signal_e, factors, (faint, one_read))[..., focus]
        crb_nm, one_read_nm = bounds.median(-1).values.numpy()
        return curve_of(one.model.psf.nolls, magnitudes, abs_error_nm, crb_nm, one_read_nm, criterion)

    return [curve(*pair) for pair in zip(configurations, errors, strict=True)]


def _bounds_nm(model, modes_nm, signal_e, factors, noises) -> torch.Tensor:
    """Bounds (noises, factors, images, parameters) of images with their light times each of the `factors`."""
    flux = signal_e.double().sum((1, 2))
    whole = model.predict_and_jacobian(modes_nm, flux, torch.zeros_like(flux))
    found = []
    for factor in factors:
        seen = whole[0] * factor, whole[1].double() * factor  # flux and background in other units
        if model.effects.at("detector"):  # derivatives are not in proportion to the light
            seen = model.predict_and_jacobian(modes_nm, flux * factor, torch.zeros_like(flux))
        found.append(torch.stack([_bound_nm(*seen, noise) for noise in noises]))
    return torch.stack(found, dim=1)


def curve_of(
    nolls: tuple[int, ...],
    magnitudes: np.ndarray,
    abs_error_nm: np.ndarray,
    crb_nm: np.ndarray,
    one_read_crb_nm: np.ndarray,
    criterion: Criterion,
) -> Curve:
    """Return the curve of single errors, which may come from several scans over the same magnitudes.

    The errors `abs_error_nm` (magnitudes, trials) are NaN where the estimate failed; bounds are
    (magnitudes,).
    """
    mag_j, trials = np.asarray(magnitudes, float), abs_error_nm.shape[1]
    failures = np.isnan(abs_error_nm).sum(axis=1)
    finite = [row[~np.isnan(row)] for row in abs_error_nm]
    nothing = [np.nan] * len(ONE_SIGMA)
    low, median, high = np.array([np.percentile(row, ONE_SIGMA) if len(row) else nothing for row in finite]).T
    limit = limiting_magnitude(mag_j, median, failures / trials, criterion)
    return Curve(
        nolls, mag_j, median, low, high, crb_nm, failures, trials, limit, abs_error_nm, one_read_crb_nm
    )


def limiting_magnitude(
    magnitudes: np.ndarray, median_nm: np.ndarray, failure_fraction: np.ndarray, criterion: Criterion
) -> float:
    """Find the faintest of the `magnitudes` before the `criterion` is missed, interpolated in log error."""
    fine = (median_nm <= criterion.median_nm) & (failure_fraction <= criterion.failure_fraction)
    if not fine[0]:
        return float("nan")
    if fine.all():
        return float(magnitudes[-1])
    first_bad = int(np.argmin(fine))
    good, bad = first_bad - 1, first_bad
    if not median_nm[bad] > criterion.median_nm:  # stopped by failures: no interpolation
        return float(magnitudes[good])
    span = np.log(median_nm[bad] / median_nm[good])
    part = np.log(criterion.median_nm / median_nm[good]) / span
    return float(magnitudes[good] + part * (magnitudes[bad] - magnitudes[good]))


def cramer_rao_nm(
    model: ImageModel,
    modes_nm: torch.Tensor,
    flux_e: torch.Tensor,
    noise: NoiseModel,
    *,
    background_e: float = 0.0,
) -> torch.Tensor:
    """Return the smallest standard errors of the modes with flux and background free, (images, modes) [nm].

    ``σ² = diag((Jᵀ V⁻¹ J)⁻¹)``, the variance V from the noise-free image; the small information that V itself
    carries is left out, as LIFT does not use it. The `model` has no free effect parameters; `modes_nm`
    (images, modes) and `flux_e` (images,) are those of the images, `background_e` is in every pixel.
    """
    flux = flux_e.double()
    seen = model.predict_and_jacobian(modes_nm, flux, torch.full_like(flux, background_e))
    return _bound_nm(*seen, noise)[:, : len(model.psf.nolls)]


def _bound_nm(image_e: torch.Tensor, columns: torch.Tensor, noise: NoiseModel) -> torch.Tensor:
    """Bounds of all parameters (images, parameters), from images and derivatives, (..., rows, columns)."""
    columns = columns.double().flatten(2)
    fisher = (columns / noise.variance_e2(image_e.flatten(1))[:, None]) @ columns.mT
    return torch.diagonal(scaled_inverse(fisher.cpu()), dim1=1, dim2=2).sqrt()
