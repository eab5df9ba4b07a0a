"""Checks beside the fit of everything: noise, motion, fine structure, single pixels.

Noise is judged from frames alone. Differences of successive frames hold the noise twice and nothing that
stands still. What flux and pointing do from frame to frame is projected out with the mean image and its
gradients. Photon noise follows the signal with the excess-noise factor; speckles of an AO residual exceed it
where it is bright.

The mean image hardly shows that wavefront or image moved. One linear step from the common solution gives
every frame its coefficients; their slopes are judged by their own scatter about the straight line. A large
drift leaves the range of one linear step: the response of the step to images that drift as measured says by
how much.

Whatever the wavefront, light ends at the cut-off D/λ of spatial frequency (Goodman 2005, Introduction to
Fourier Optics, section 6.3); motion and pixels only weaken what is below. What a mean image has beyond, and
noise does not explain, was made behind the optics: by an error of the flat, by single pixels, by a response
that is not linear. Speckles do not reach there, so it shows down to photon noise on sky as well. A model of
the detector reaches beyond as well. What it has there and the data have not is its mistake, and no structure
of theirs: what counts is what the data have, and what the model leaves of it.

Single pixels that are bad stand out where the model explains their neighbours well.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import chdtri, ndtr

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.conventions.units import cutoff_per_px
from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import FittedModel, Optimum, gaussian_sigma, surely_exceeding
from irlos_pipe.diagnosis.records import FineStructure, NoiseVerdict
from irlos_pipe.diagnosis.scores import Family
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.detector import BadPixels
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.wavefront import NcpaDrift
from irlos_pipe.estimate.cube import local_mean
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.solver import scaled_inverse
from irlos_pipe.optics.psf_settings import PsfSettings

# -- noise -------------------------------------------------------------------------------------

FAINT, BRIGHT = 0.5, 0.02  # share of the pixels that are faint; of the peak, from which pixels are bright
SPECKLE = 1.3  # measured over predicted variance of bright pixels from which speckles set the scatter
TOLERANCE = 0.3  # relative deviation of a variance within which the noise model holds
PHOTONS, SPECKLES, UNSEEN = "photon-limited", "speckle-limited", "unseen"


def judge_all(stacks: Sequence[Stack]) -> NoiseVerdict:
    """Noise verdict of the recording that deviates most from the noise model; speckles take precedence."""
    found = [judge_noise(stack) for stack in stacks]
    found = [one for one in found if one.kind != UNSEEN] or found[:1]
    found = [one for one in found if one.kind == SPECKLES] or found
    return max(found, key=lambda one: abs(np.log(max(one.bright_ratio, 1e-9))))


def judge_noise(stack: Stack) -> NoiseVerdict:
    """Compare variances with the noise model's."""
    if len(stack) < 2:
        return NoiseVerdict(UNSEEN, text="as declared: one frame shows no scatter")
    images = stack.frames.images_e.double().numpy()
    good = stack.frames.good.numpy()
    mean = images.mean(0)
    differences = np.diff(images, axis=0).reshape(len(images) - 1, -1)
    shapes = np.stack([mean, *np.gradient(mean), np.ones_like(mean)]).reshape(4, -1)
    basis = np.linalg.qr(shapes.T)[0]
    quiet = differences - (differences @ basis) @ basis.T
    measured = (quiet**2).mean(0).reshape(mean.shape) / 2
    predicted = stack.frames.noise.scatter_e2(torch.as_tensor(mean)).numpy()
    bright = good & (mean > BRIGHT * mean.max())
    faint = good & (mean < np.quantile(mean[good], FAINT))
    ratios = [float(measured[where].sum() / predicted[where].sum()) for where in (bright, faint)]
    return _verdict(SPECKLES if ratios[0] > SPECKLE else PHOTONS, *ratios)


def _verdict(kind: str, in_bright: float, in_faint: float) -> NoiseVerdict:
    """It holds if nothing is quieter than the noise model, nor louder without speckles to blame."""
    quietest = min(in_faint, in_bright)
    holds = quietest > 1 - TOLERANCE and (kind != PHOTONS or in_faint < 1 + TOLERANCE)
    ratios = f"{in_bright:.2f} in bright, {in_faint:.2f} in faint pixels"
    text = f"{kind}, variance over prediction {ratios}"
    return NoiseVerdict(
        kind, in_bright, in_faint, holds, text if holds else f"{text}; the noise model does not hold"
    )


# -- motion ------------------------------------------------------------------------------------

NOLLS = range(2, 12)  # low modes, of which a drift is measured
TIMES = 9  # moments of a recording at which a model with a drift is evaluated


@dataclass(frozen=True)
class Drift:
    """Straight lines through the coefficients of the frames."""

    nolls: tuple[int, ...]
    change_nm: np.ndarray  # (modes,), from the first frame to the last
    sigma_nm: np.ndarray  # (modes,)
    significance: float  # in Gaussian σ, pointing left out
    recording: int = 0  # in which it was seen, by number

    def detectable_nm(self, sure: float) -> np.ndarray:
        """Change of each mode alone that would surely be significant, (modes,)."""
        tested = sum(noll not in TIP_TILT for noll in self.nolls)
        limit = float(chdtri(tested, ndtr(-sure)))
        return self.sigma_nm * np.sqrt(surely_exceeding(limit, tested))

    def effect(self) -> FixedEffect:
        """The drift, held at what was measured."""
        return FixedEffect(NcpaDrift(self.nolls), self.change_nm)


def measure_drift(stack: Stacks, fitted: Fitted, sure: float) -> Drift:
    """Slopes of the low modes, and their joint significance, in the recording where that is highest.

    A drift more significant than `sure` is worth more than one linear step.
    """
    steps = [LinearStep(one, *own) for one, own in zip(stack.parts, fitted.recordings, strict=True)]
    drifts = [(step, _drift(step, trials=len(steps))) for step in steps]
    step, drift = max(drifts, key=lambda one: one[1].significance)
    drift = replace(drift, recording=steps.index(step))
    if drift.significance < sure:
        return drift
    beyond_linear = drift.change_nm - step.of_a_drift(drift.change_nm)
    return replace(drift, change_nm=drift.change_nm + beyond_linear)


class LinearStep:
    """One linear step from the solution `x`, (1, parameters), for the mean of one recording by itself."""

    def __init__(self, stack: Stack, part: ImageFit, x: torch.Tensor):
        self.stack, self.part, self.x = stack, part, x
        self.nolls = tuple(noll for noll in NOLLS if noll in part.layout.nolls)
        rows = part.layout.modes.start + np.array([part.layout.nolls.index(noll) for noll in self.nolls])
        hessian = part.normal_equations(x, torch.arange(1))[2]
        jacobian = part.predict_and_jacobian(x)[1][0].cpu().double()
        self._gain = (scaled_inverse(hessian)[0] @ (jacobian * stack.root))[rows]

    def modes_nm(self, deviations: torch.Tensor) -> np.ndarray:
        """Low modes (images, modes) of whitened `deviations` from the mean image, (images, pixels)."""
        return (deviations @ self._gain.mT).numpy()

    def of_a_drift(self, change_nm: np.ndarray) -> np.ndarray:
        """The slopes that it finds in images of the model whose wavefront drifts, (modes,)."""
        layout, (first, last) = self.part.layout, (self.stack.when.min(), self.stack.when.max())
        when = first + (np.arange(TIMES) + 0.5) / TIMES * (last - first)
        held = self.part.model.effects.held(self.x[0, layout.effect_values]).effects
        model = ImageModel(self.part.model.psf, [*held, FixedEffect(NcpaDrift(self.nolls), change_nm)])
        modes, flux, background = (self.x[:, at].expand(TIMES, -1) for at in (layout.modes, [-2], [-1]))
        images = model.predict(modes, flux[:, 0], background[:, 0], when=torch.as_tensor(when))
        images = images.cpu().flatten(1)
        return slopes(self.modes_nm((images - images.mean(0)) * self.stack.root), when)


def slopes(series: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Slopes of straight lines through the columns of `series` at the times `when`, (columns,)."""
    course = when - when.mean()
    return course @ series / (course @ course)


def _drift(step: LinearStep, trials: int) -> Drift:
    """The drift of one recording, as the linear step has it."""
    stack, nolls = step.stack, step.nolls
    series, course = step.modes_nm(stack.deviations), stack.when - stack.when.mean()
    change = slopes(series, stack.when)
    scatter = np.cov((series - np.outer(course, change)).T) * (len(stack) - 1) / (len(stack) - 2)
    covariance = scatter / (course @ course) * len(stack) / stack.independent
    tested = [i for i, noll in enumerate(nolls) if noll not in TIP_TILT]
    own = covariance[np.ix_(tested, tested)]
    hotelling = float(change[tested] @ np.linalg.solve(own, change[tested]))
    significance = gaussian_sigma(hotelling, len(tested), stack.independent - 1, trials)
    return Drift(nolls, change, np.sqrt(np.diag(covariance)), significance)


MOVING = 1.5  # variance ratio from which frames move


def motion_ratio(stack: Stacks, fitted: Fitted) -> float:
    """Variance of tip and tilt between successive frames over that of photon noise.

    Well above 1 for motion, whether or not most of it averages out within a frame; 1 for a detector
    that blurs. Of several recordings, which `stack` and `fitted` hold, it is the mean. NaN where frames
    are too few to show it.
    """
    if stack.held_out == "pixels":
        return float("nan")
    pairs = zip(stack.parts, fitted.recordings, strict=True)
    return float(np.mean([_ratio(one, *own) for one, own in pairs]))


def _ratio(stack: Stack, part: ImageFit, x: torch.Tensor) -> float:
    frames = stack.frames
    columns = part.predict_and_jacobian(x)[1][0, [0, 1, -2, -1]].cpu().double().mT
    variance = frames.noise.variance_e2(stack.mean_e)
    root = torch.where(frames.good.flatten(), variance**-0.5, 0.0)
    whitened = columns * root[:, None]
    covariance = torch.linalg.inv(whitened.mT @ whitened)
    images = frames.images_e.double().flatten(1) * root
    values = (images @ whitened @ covariance)[:, :2].numpy()
    steps = np.diff(values, axis=0)
    return float(np.mean(steps.var(0) / (2 * np.diag(covariance.numpy())[:2])))


# -- fine structure ----------------------------------------------------------------------------

MAIN_LOBE = 2  # half width of a Hann window's, in frequencies of the window: beyond it little leaks
FADED = 0.1  # of the window's middle, below which pixels are left out
REGRESSIONS, SURELY = 4, 5.0  # steps for the flat's error; standard errors from which it is believed
MIN_SHARE = 0.1  # of all frequencies; with less beyond the cut-off, pixels are too coarse to show any


def fine_structure(optimum: Optimum) -> FineStructure:
    """Fine structure that a fitted model does not explain, the most significant of its recordings.

    With pixels held out it cannot be told from the gaps they leave.
    """
    if optimum.stack.held_out == "pixels":
        return FineStructure()
    fitted = optimum.fitted
    found = [
        structure_of(part, fitted.image_e[pixels], view.psf.settings)
        for part, pixels, view in zip(optimum.stack.parts, fitted.problem.pixels, fitted.views, strict=True)
    ]
    return max(found, key=lambda one: one.significance)


def structure_of(stack: Stack, model_e: torch.Tensor, settings: PsfSettings) -> FineStructure:
    """Fine structure of one recording: the lesser of what it has and of what a model leaves of it.

    `model_e` is its mean image by the model [e-], (pixels,).
    """
    beyond = Beyond(stack.frames.good, highest_frequency_per_px(settings))
    if beyond.share < MIN_SHARE:
        return FineStructure()
    deviations_e = torch.where(stack.root > 0, stack.deviations / stack.root, 0.0)
    frames = beyond(deviations_e.reshape(-1, *settings.window)) ** 2
    scatter = local_mean(frames.sum(0) / (len(frames) - 1), beyond.weight)
    shared = beyond.share * beyond.fade**2 * stack.frames.noise.shared_e2
    left = beyond((stack.mean_e - model_e).reshape(1, *settings.window))[0]
    own = left + beyond.of_whole(model_e.reshape(settings.window))
    noise = (frames / scatter)[:, beyond.inside].mean(1) * len(frames) / (len(frames) - 1)
    means = [(part**2 / (scatter / len(frames) + shared))[beyond.inside].mean() for part in (left, own)]
    power = float(min(means))
    return FineStructure(power / float(noise.mean()), _significance(power, noise.numpy()))


def _significance(power: float, of_noise: np.ndarray) -> float:
    """Gaussian σ of a `power` against those that noise gives frames, (frames,).

    The power of noise is a χ² with few degrees, as bright pixels have most of it: its cube root is nearly
    normal (Wilson & Hilferty 1931, PNAS 17, 684). A further draw is judged by Student's t, as the Gaussian
    deviate of the same probability (Wallace 1959, Annals of Mathematical Statistics 30, 1121).
    """
    roots, degrees = np.cbrt(of_noise), len(of_noise) - 1
    t = (np.cbrt(power) - roots.mean()) / (roots.std(ddof=1) * np.sqrt(1 + 1 / len(roots)))
    sigma = (8 * degrees + 1) / (8 * degrees + 3) * np.sqrt(degrees * np.log1p(t**2 / degrees))
    return float(np.copysign(sigma, t))


def flat_rms(stack: Stack, residual_e: torch.Tensor, settings: PsfSettings) -> float:
    """Relative error of the flat that explains fine structure beyond noise; 0 where it is not significant.

    The squares of `residual_e`, the mean image minus that of a model [e-], (pixels,), filtered for what lies
    beyond the cut-off, are v + f² m² on average, with what the filter leaves of noise v and of the squared
    image m²: f² is their weighted regression.
    """
    good = stack.frames.good
    beyond = Beyond(good, highest_frequency_per_px(settings))
    if beyond.share < MIN_SHARE:
        return 0.0
    image = stack.mean_e.reshape(settings.window)
    noise = beyond.power(stack.frames.noise.mean_variance_e2(image, len(stack)))
    square = beyond.power(image**2)
    power = beyond(residual_e.reshape(1, *settings.window))[0] ** 2
    inside, f2, sigma = beyond.inside, 0.0, np.inf
    for _ in range(REGRESSIONS):
        weight = ((noise + f2 * square) ** -2)[inside]
        norm = (weight * square[inside] ** 2).sum()
        f2 = max(0.0, float((weight * (power - noise)[inside] * square[inside]).sum() / norm))
        sigma = float((2 / norm) ** 0.5)
    return float(np.sqrt(f2)) if f2 > SURELY * sigma else 0.0


def highest_frequency_per_px(settings: PsfSettings) -> float:
    """Highest spatial frequency of an image, D/λ of the shortest wavelength [cycles/px]."""
    return cutoff_per_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)


class Beyond:
    """Filter for what lies beyond a spatial frequency, in a window that fades out towards its border (Hann).

    Of `good`, (rows, columns), bad pixels are False; they are filled from around them.
    """

    def __init__(self, good: torch.Tensor, frequency_per_px: float):
        self.weight = good.double()
        rows, columns = (torch.fft.fftfreq(size, dtype=torch.float64) for size in good.shape)
        least = frequency_per_px + MAIN_LOBE / min(good.shape)
        self.band = torch.hypot(rows[:, None], columns) > least
        edges = (torch.arange(size, dtype=torch.float64) + 0.5 for size in good.shape)
        hann = (torch.sin(np.pi * one / len(one)) ** 2 for one in edges)
        self.fade = torch.outer(*hann)

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        """The filtered images (images, rows, columns)."""
        filled = (torch.where(self.weight > 0, one, local_mean(one, self.weight)) for one in images)
        return self.of_whole(torch.stack([*filled]))

    def of_whole(self, images: torch.Tensor) -> torch.Tensor:
        """The filtered images (…, rows, columns) that have no bad pixels."""
        return torch.fft.ifft2(torch.fft.fft2(images * self.fade) * self.band).real

    def power(self, variance: torch.Tensor) -> torch.Tensor:
        """Variance of the filtered image of uncorrelated pixels of some `variance`, (rows, columns)."""
        kernel = torch.fft.fft2(torch.fft.ifft2(self.band.double()).abs() ** 2)
        return torch.fft.ifft2(torch.fft.fft2(variance * self.fade**2) * kernel).real.clamp_min(0.0)

    @property
    def share(self) -> float:
        """Part of all frequencies that passes."""
        return float(self.band.double().mean())

    @property
    def inside(self) -> torch.Tensor:
        """Good pixels where the window has not faded."""
        return (self.weight > 0) & (self.fade > FADED)


# -- single pixels -----------------------------------------------------------------------------

OUTSTANDING = 50.0  # fall of χ² by a pixel's own offset: 7 σ, one of some thousand pixels
ALONE = 4.0  # times the largest residual of the neighbours, above which a pixel stands alone
MOST = 20  # pixels of the family at most


def outstanding_pixels(optimum: FittedModel) -> list[tuple[int, int]]:
    """(row, column) of the pixels that nothing smooth explains, the worst first."""
    problem = optimum.fitted.problem
    left = 1 - (optimum.basis**2).sum(1)
    pulls = (optimum.residual / left.clamp_min(1e-6).sqrt()).abs().reshape(-1, *problem.window)
    pull = pulls.amax(0)
    # The largest of the eight neighbours of every pixel.
    rows, columns = pull.shape
    padded = torch.nn.functional.pad(pull[None, None], (1, 1, 1, 1))[0, 0]
    shifted = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3) if (r, c) != (1, 1)]
    around = torch.stack(shifted).amax(0)
    chosen = (pull**2 > OUTSTANDING) & (pull > ALONE * around)
    found = torch.nonzero(chosen)[pull[chosen].argsort(descending=True)]
    return [(int(row), int(column)) for row, column in found[:MOST]]


def smallest_excess(optimum: Optimum) -> dict[str, dict[str, float]]:
    """Excess of a pixel that would surely stand out, median over the window [e-], under the effect's name."""
    error = optimum.stack.variance_e2.sqrt()
    pull = surely_exceeding(OUTSTANDING, 1) ** 0.5
    return {BadPixels.name: {"excess_e": float(pull * error[error.isfinite()].median())}}


def bad_pixel_family(optimum: FittedModel) -> list[Family]:
    """The joint family of these pixels; none where there are none, or where the model lists some."""
    if any(effect.found_by == "pixels" for effect in optimum.fitted.effects):
        return []
    pixels = outstanding_pixels(optimum)
    looked_at = int((optimum.root > 0).sum())
    return [Family((BadPixels(pixels),), looked_at)] if pixels else []
