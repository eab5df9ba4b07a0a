"""One posterior of everything in the mean images: all visible modes, facts, effects, and what no model has.

Parameters are all modes that the window shows, everything declared with its tolerance as prior, effects that
may be there, pointing, flux and background. Their priors are Gaussian and proper, so that models compare by
their evidence. The errors of the mean images have a covariance, as speckles and what a model misses change
neighbouring pixels alike:

    C = photons + (f · light)² + S^½ (speckles + s² · light · peak) S^½ + the frames' own covariance

with the error f of the flat, which is that of every pixel by itself, the error s of the model at the peak of
the image, and the correlation S of speckles, that of the light in an Airy disc. Light that a model has in the
wrong place interferes with the star's as speckles do, so its variance follows the light (Aime and Soummer
2004, ApJ 612, L85). The law of the modes and s and f are hyper-parameters: they maximise the evidence, all
parameters following linearly.

With H = Jᵀ C⁻¹ J + P at the optimum, P the precisions of the priors, the evidence by Laplace is

    ln Z = −½ χ² − ½ χ²(priors) − ½ ln det H + ½ ln det P − ½ ln det C

(MacKay 1992, Neural Comput. 4, 415). An effect enters by the evidence of two models of which each has the
hyper-parameters that suit it: what is missing makes the error of the model larger, which hides it. Starts,
forms of an effect, and candidates before one of them enters, are compared at common ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from scipy.optimize import minimize

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitting import Fitted, Fitter, JointFit
from irlos_pipe.diagnosis.null_model import FittedModel
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.calibration_options import FOCUS_NM, POINTING_NM
from irlos_pipe.estimate.cube import local_mean
from irlos_pipe.estimate.open_fit import TailLaw, last_noll_of, visible_order
from irlos_pipe.estimate.score_test import NullModel
from irlos_pipe.numerics.parallel import ordered_map
from irlos_pipe.numerics.solver import CONVERGED, Solution
from irlos_pipe.optics.psf_settings import PsfSettings

DISC = 0.86  # of speckles' correlation sinc²(DISC · D x/λ) along an axis, as wide at half as an Airy disc's
SMOOTHED, SAMPLED = 0.6, 0.4  # parts of the speckles' variance correlated as an Airy disc, and as frames show
FAINTEST = 0.03  # part of the variance of the strongest shape along an axis, below which one is left out
NOTHING = 1e-6  # correlated variance over that of single pixels, which rounding may leave of an axis
MODEL_ERRORS = (0.0, 0.0015, 0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2)  # s that are tried
FLAT_ERRORS = (0.0, 0.0015, 0.003, 0.005, 0.008, 0.012, 0.02, 0.04)  # f that are tried
FIRST_MODEL_ERROR, FIRST_FLAT_ERROR = 0.05, 0.005
CONVERGED_AT = 1.0  # fall of χ² still ahead at which evidence is known well enough
EXACT_FROM = 100.0  # fall of χ² ahead from which derivatives are those of all colours
CHORDS = 8  # steps with the same derivatives at most
TRIALS = 8  # of a step, with ten times the damping each
LAW_TOLERANCES = {"xatol": 0.03, "fatol": 0.05, "maxfev": 150}
LAW_SIMPLEX = np.array([[0, 0, 0], [0.4, 0, 0], [0, -1.0, 0], [0, 0, 0.7]])
LAW_EXPECTED, LAW_WIDTH = np.array([0.0, 0.0, 1.0]), np.array([1.0, 3.0, 2.0])  # of ln k, ln A and p


@dataclass(frozen=True)
class WavefrontLaw:
    """Standard deviation of the modes: k times the instrument's law, and beyond the closed basis a tail's."""

    known: NcpaLaw | None  # without one, that of the tail is that of all modes
    tail: TailLaw
    scale: float = 2.0  # k

    @classmethod
    def of(cls, known: NcpaLaw | None, highest_noll: int) -> WavefrontLaw:
        """Before anything is known but the closed basis, which ends at `highest_noll`."""
        return cls(known, TailLaw(5, 50.0) if known is None else TailLaw(highest_noll + 1, 4.0))

    def sigma_nm(self, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the standard deviation of modes, (modes,) [nm RMS]; tip, tilt and focus are almost free."""
        noll, sigma = np.asarray(nolls), self.tail.sigma_nm(nolls)
        if self.known is not None:
            sigma = np.where(noll < self.tail.first_noll, self.scale * self.known.sigma_nm(noll), sigma)
        return np.where(noll < 4, POINTING_NM, np.where(noll == 4, FOCUS_NM, sigma))

    def changed(self, x: np.ndarray) -> WavefrontLaw:
        """Return the law with other ln k, ln A and p."""
        tail = replace(self.tail, amplitude_nm=math.exp(x[1]), slope=float(x[2]))
        return replace(self, scale=math.exp(x[0]), tail=tail)


@dataclass(frozen=True)
class _Scatter:
    """What frames show of the errors of one mean image."""

    photons_e2: torch.Tensor  # (pixels,), infinite for pixels that no fit sees
    speckles_e2: torch.Tensor  # (pixels,)
    image_e: torch.Tensor  # (pixels,)
    light_e: torch.Tensor  # (pixels,), the same smoothed
    airy: _Airy  # what is correlated as an Airy disc, with variance one
    sample_e: torch.Tensor  # (pixels, frames): the frames' own covariance is its square

    @classmethod
    def of(cls, stack: Stack, settings: PsfSettings, *, by_frames: bool) -> _Scatter:
        """The scatter of the frames counts where it is more than photons' and there are enough of them."""
        frames, good = stack.frames, stack.root > 0
        weights = good.reshape(frames.good.shape).double()
        count = len(frames.images_e)
        light = local_mean(stack.mean_e.reshape(weights.shape), weights).clamp_min(0).flatten()
        speckles, sample = torch.zeros_like(light), light.new_zeros(len(light), 0)
        photons = stack.variance_e2
        if by_frames:
            slow = count / stack.independent
            photons = frames.noise.scatter_e2(frames.mean_e).flatten() / count + frames.noise.shared_e2
            scatter = local_mean(frames.scatter_e2, weights).flatten() / count
            speckles = (slow * (scatter - photons)).clamp_min(0)
            sample = stack.differences_e.mT * math.sqrt(SAMPLED * slow / count / (count - 1))
        photons = torch.where(good, photons.double(), torch.inf)
        return cls(photons, SMOOTHED * speckles, stack.mean_e, light, _Airy.of(settings), sample.float())


@dataclass(frozen=True)
class _Airy:
    """Root of the correlation of speckles between the pixels of a window, (pixels, m); it is separable."""

    along_y: torch.Tensor  # (rows, ·)
    along_x: torch.Tensor  # (columns, ·)

    @classmethod
    def of(cls, settings: PsfSettings) -> _Airy:
        axes = []
        for size in settings.window:
            apart = np.subtract.outer(np.arange(size), np.arange(size)) * DISC / settings.resolution_px
            values, vectors = np.linalg.eigh(np.sinc(apart) ** 2)
            kept = values > FAINTEST * values.max()
            axes.append(torch.as_tensor(vectors[:, kept] * np.sqrt(values[kept]), dtype=torch.float32))
        return cls(*axes)

    @property
    def shapes(self) -> torch.Tensor:
        """Itself, (pixels, m)."""
        return torch.kron(self.along_y, self.along_x)

    def seen(self, images: torch.Tensor) -> torch.Tensor:
        """Its products with images (pixels, n), (m, n)."""
        cube = images.mT.reshape(-1, len(self.along_y), len(self.along_x))
        return (self.along_y.mT @ cube @ self.along_x).flatten(1).mT

    def made(self, sizes: torch.Tensor) -> torch.Tensor:
        """Images (pixels, n) with so much of every shape, (m, n)."""
        cube = sizes.mT.reshape(sizes.shape[1], self.along_y.shape[1], self.along_x.shape[1])
        return (self.along_y @ cube @ self.along_x.mT).flatten(1).mT


@dataclass(frozen=True)
class Covariance:
    """Covariance of mean images as what whitens them, C = R⁻¹ (1 + A Aᵀ) R⁻¹ for each; R is diagonal."""

    scatter: Sequence[_Scatter]  # of every recording
    model_rms: float = FIRST_MODEL_ERROR  # s
    flat_rms: float = FIRST_FLAT_ERROR  # f
    known: dict[tuple[float, float], Covariance] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, stack: Stacks, views: Sequence[View]) -> Covariance:
        by_frames = stack.held_out == "frames" and not stack.photon_limited
        pairs = zip(stack.parts, views, strict=True)
        return cls([_Scatter.of(part, view.psf.settings, by_frames=by_frames) for part, view in pairs])

    def alone(self, louder: float) -> Covariance:
        """Of pixels each by itself, with the variance of so many times their photons', and the flat's."""
        scatter = []
        for one in self.scatter:
            airy = _Airy(one.airy.along_y[:, :0], one.airy.along_x[:, :0])
            photons_e2 = louder * one.photons_e2
            scatter.append(replace(one, photons_e2=photons_e2, airy=airy, sample_e=one.sample_e[:, :0]))
        return Covariance(scatter, 0.0, self.flat_rms)

    @cached_property
    def root(self) -> torch.Tensor:
        """One over the standard errors that pixels have each by itself, 0 for those not seen, (pixels,)."""
        own = (one.photons_e2 + (self.flat_rms * one.image_e) ** 2 for one in self.scatter)
        return torch.cat([variance**-0.5 for variance in own])

    def with_errors(self, model_rms: float, flat_rms: float) -> Covariance:
        """The same with other errors of model and flat; those tried before are known."""
        key = model_rms, flat_rms
        if key == (self.model_rms, self.flat_rms):
            return self
        if key not in self.known:
            self.known[key] = replace(self, model_rms=model_rms, flat_rms=flat_rms)
        return self.known[key]

    @cached_property
    def _scales(self) -> list[tuple[slice, torch.Tensor, torch.Tensor]]:
        """For each recording its pixels, and what the two parts of A have in them, whitened, (pixels, 1)."""
        found, begin = [], 0
        for one in self.scatter:
            at = slice(begin, begin := begin + len(one.light_e))
            rms = (one.speckles_e2 + self.model_rms**2 * one.light_e.max() * one.light_e).sqrt()
            root = self.root[at, None]
            found.append((at, (root * rms[:, None]).float(), root.float()))
        return found

    @cached_property
    def _inside(self) -> tuple[float, list[torch.Tensor]]:
        """ln det(1 + A Aᵀ), and for each recording M of (1 + A Aᵀ)^(−½) = 1 − A M Aᵀ."""
        log_determinant, found = 0.0, []
        for one, (_, airy, own) in zip(self.scatter, self._scales, strict=True):
            whole = torch.cat([one.airy.shapes * airy, one.sample_e * own], 1)
            values, vectors = torch.linalg.eigh((whole.mT @ whole).double())
            values = values.clamp_min(NOTHING)
            log_determinant += float(torch.log1p(values).sum())
            found.append((vectors * ((1 - (1 + values) ** -0.5) / values) @ vectors.mT).float())
        return log_determinant, found

    @cached_property
    def log_determinant(self) -> float:
        return self._inside[0] - 2 * float(self.root[self.root > 0].log().sum())

    def whiten(self, shapes: torch.Tensor) -> torch.Tensor:
        """C^(−½) times shapes, (pixels, m)."""
        white = shapes * self.root[:, None]
        for one, (at, airy, own), inner in zip(self.scatter, self._scales, self._inside[1], strict=True):
            there = white[at].float()
            along = inner @ torch.cat([one.airy.seen(airy * there), one.sample_e.mT @ (own * there)])
            smooth, sampled = along.tensor_split([len(along) - one.sample_e.shape[1]])
            white[at] -= airy * one.airy.made(smooth) + own * (one.sample_e @ sampled)
        return white


def with_visible_modes(fitter: Fitter) -> tuple[Fitter, list[View]]:
    """Return the `fitter` with all modes that the window shows, and its views in few colours.

    Of several recordings they have the modes of the `fitter`.
    """
    views = fitter.views
    nolls: Sequence[int] = views[0].psf.nolls
    if len(views) == 1:
        visible = last_noll_of(visible_order(views[0].psf.settings))
        nolls = range(2, max(visible, nolls[-1]) + 1)
    exact = [view.with_modes(nolls) for view in views]
    return fitter.of(fitter.stack, exact), [view.with_modes(nolls, few_colours=True) for view in views]


@dataclass(eq=False)
class Posterior:
    """A model of the images with its priors."""

    fitter: Fitter  # with the mean images and their light paths, of all colours
    few_colours: Sequence[View]  # the light paths for rough derivatives
    effects: Sequence[Effect]
    covariance: Covariance
    law: WavefrontLaw
    exact: JointFit = field(init=False)
    coarse: JointFit = field(init=False)
    prior_mean: torch.Tensor = field(init=False)  # (parameters,)
    prior_precision: torch.Tensor = field(init=False)  # (parameters,)

    def __post_init__(self):
        views = self.fitter.views, self.few_colours
        exact, coarse = (self.fitter.problem(self.effects, some) for some in views)
        mean, precision = exact.prior_mean[0].clone(), exact.prior_precision[0].clone()
        precision[exact.layout.modes] = torch.as_tensor(self.law.sigma_nm(exact.layout.nolls)) ** -2
        begin = exact.layout.effect_values.start
        for label, effect in zip(exact.effects.labels, exact.effects.effects, strict=True):
            columns = [begin + index for index in exact.effects.columns_of(label)]
            declared = {one.name: one for one in effect.base.parameters}  # what is held does not move priors
            for column, parameter in zip(columns, effect.parameters, strict=True):
                mean[column], sigma = declared[parameter.name].proper_prior
                precision[column] = sigma**-2
        self.exact, self.coarse = exact, coarse
        self.prior_mean, self.prior_precision = mean, precision

    @property
    def sharp(self) -> Posterior:
        """The same without an error of the model, which grows by what is missing and hides it."""
        return replace(self, covariance=self.covariance.with_errors(0.0, self.covariance.flat_rms))

    def penalty(self, x: torch.Tensor) -> float:
        """What the priors add to χ² at `x`, (1, parameters)."""
        return float((self.prior_precision * (x[0] - self.prior_mean) ** 2).sum())

    def left(self, x: torch.Tensor) -> tuple[torch.Tensor, float]:
        """What is left of the images, whitened, and half of χ² and priors, infinite where it is not known."""
        try:
            left = self.covariance.whiten((self.fitter.stack.mean_e - self.exact.predict(x))[:, None])[:, 0]
        except ValueError:  # a wavelength out of the grid
            return torch.zeros_like(self.fitter.stack.mean_e), math.inf
        value = 0.5 * (float(left @ left) + self.penalty(x))
        return left, value if math.isfinite(value) else math.inf

    def start(self, near: Fitted | None = None) -> torch.Tensor:
        """Where a fit begins: nothing but the star at its place and the effects, or all else `near` by."""
        return self.fitter.start(self.exact, near).clamp(self.exact.lower, self.exact.upper)

    def minimised(
        self, x: torch.Tensor, iterations: int, *, roughly: bool = False, slopes: torch.Tensor | None = None
    ) -> Laplace:
        """The optimum, from the parameters `x`, (1, parameters)."""
        x, _, slopes = self.descended(x, iterations, roughly=roughly, slopes=slopes)
        return Laplace(self, x, coarse=roughly, columns=slopes)

    def descended(
        self,
        x: torch.Tensor,
        iterations: int,
        *,
        roughly: bool = False,
        held: Sequence[int] = (),
        slopes: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, float, torch.Tensor | None]:
        """Parameters, half of χ² and priors there, and derivatives, by Levenberg and Marquardt's method.

        An iteration takes the derivatives once, which cost ten images, and goes on with them as long as χ²
        falls as they predict (the chord method). They are rough while far off, or all the way; in the first
        iteration they are `slopes`, where those are known from near by. Those of an iteration after which
        nothing is ahead are those of the optimum; there are none after so many `iterations` without one.
        Parameters that push against a bound stay there, those `held` where they are.
        """
        (left, value), damping, coarse = self.left(x), 1e-3, True
        lower, upper = self.exact.lower.clone(), self.exact.upper.clone()
        lower[..., held] = upper[..., held] = x[0, held]
        for _ in range(iterations):
            columns, fresh = slopes, slopes is None
            if columns is None:
                columns = (self.coarse if coarse else self.exact).predict_and_jacobian(x)[1]
            design, slopes = self.covariance.whiten(columns.mT), None
            hessian = self.hessian(design)
            before, first, enough = value, math.inf, CONVERGED_AT * max(1.0, value / self.exact.freedom)
            for _ in range(CHORDS):
                gradient = self.gradient(x, design, left)
                step_of, ahead = _steps(x, gradient, hessian, lower, upper)
                first = ahead if first == math.inf else first
                fall = 0.0
                for _ in range(0 if ahead < enough else TRIALS):
                    step = step_of(damping)
                    trial = torch.minimum(torch.maximum(x + step, lower), upper)
                    left_then, new = self.left(trial)
                    if new < value:
                        predicted = float(-gradient @ step - 0.5 * step @ hessian @ step)
                        fall, x, left, value = value - new, trial, left_then, new
                        damping = max(damping * (0.1 if fall > 0.5 * predicted else 1.0), 1e-9)
                        break
                    damping *= 10
                if fall < enough or fall < 0.5 * predicted:
                    break
            if before - value < enough:
                if roughly or not coarse:
                    return x, value, columns if fresh else None
                damping = max(min(damping, 1.0), 1e-3)
            coarse = roughly or (coarse and before - value >= enough and first >= EXACT_FROM)
        return x, value, None

    def gradient(self, x: torch.Tensor, design: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
        """Of half of χ² and priors, by whitened derivatives and what is left."""
        return self.prior_precision * (x[0] - self.prior_mean) - design.mT @ left

    def hessian(self, design: torch.Tensor) -> torch.Tensor:
        """The same of Gauss and Newton."""
        return design.mT @ design + torch.diag(self.prior_precision)


def _steps(x, gradient, hessian, lower, upper):
    """Damped steps as a function of the damping, and the fall of χ² that the undamped one predicts."""
    held = ((x[0] <= lower) & (gradient > 0)) | ((x[0] >= upper) & (gradient < 0)) | (hessian.diagonal() <= 0)
    gradient = gradient * ~held
    hessian = hessian * (~held[:, None] & ~held) + torch.diag(held.double())
    scale = hessian.diagonal().sqrt()
    scaled, unit = hessian / scale[:, None] / scale, torch.eye(len(hessian), dtype=hessian.dtype)

    def step(damping: float) -> torch.Tensor:
        return -torch.linalg.solve(scaled + (damping + 1e-12) * unit, gradient / scale) / scale

    return step, float(-gradient @ step(0.0))


def _factored(hessian: torch.Tensor, jitter: float = 1e-13) -> tuple[torch.Tensor, torch.Tensor]:
    """Cholesky factor of a Hessian in scaled variables, with a `jitter`, and their scales."""
    scale = hessian.diagonal().clamp_min(1e-300).sqrt()
    unit = torch.eye(len(scale), dtype=scale.dtype)
    return torch.linalg.cholesky(hessian / scale[:, None] / scale + jitter * unit), scale


def _inside(factor: torch.Tensor, scale: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """L⁻¹ Rᵀ of rows (n, parameters) in scaled variables, by the Cholesky factor L, (parameters, n)."""
    return torch.linalg.solve_triangular(factor, (rows / scale).mT, upper=False)


class Laplace(FittedModel):
    """A posterior about its optimum `x`, (1, parameters), and the null model of score tests there.

    Its derivatives are the `columns`, where these are known, or else `coarse` or exact. All its priors are
    proper, so that tests leave out nothing but what rounding makes of nothing.
    """

    least_seen = 1e-5

    def __init__(
        self,
        posterior: Posterior,
        x: torch.Tensor,
        *,
        coarse: bool = False,
        columns: torch.Tensor | None = None,
    ):
        self.posterior, self.x, self.stack = posterior, x, posterior.fitter.stack
        problem = posterior.coarse if coarse else posterior.exact
        self.columns = problem.predict_and_jacobian(x)[1] if columns is None else columns
        self.image = posterior.exact.predict(x)
        left, design = (self.stack.mean_e - self.image)[:, None], self.whiten(self.columns.mT)
        residual = self.whiten(left)[:, 0]
        gradient, self.hessian = posterior.gradient(x, design, residual), posterior.hessian(design)
        self.factor, self.scale = factored = _factored(self.hessian)
        unconverged, basis = _inside(*factored, -gradient[None])[:, 0], _inside(*factored, design).mT
        super().__init__(residual, posterior.covariance.root, basis, unconverged)
        half = 0.5 * (float((residual**2).sum()) + posterior.penalty(x))
        value = torch.tensor([half], dtype=torch.float64)
        solution = Solution(x, self.covariance[None], [CONVERGED], torch.ones(1, dtype=torch.int64), value)
        self.fitted = fitted_as(
            problem, solution, self.stack, posterior.fitter.views, self.image, self.columns
        )

    @cached_property
    def log_evidence(self) -> float:
        """ln Z, but for a constant of the data and of flux and background, whose priors are flat."""
        posterior = self.posterior
        precision = posterior.prior_precision[posterior.prior_precision > 0]
        volume = 2 * float(self.factor.diagonal().log().sum() + self.scale.log().sum())
        chi2 = float((self.residual**2).sum()) + posterior.penalty(self.x)
        return 0.5 * (float(precision.log().sum()) - chi2 - volume - posterior.covariance.log_determinant)

    @cached_property
    def covariance(self) -> torch.Tensor:
        """Of the parameters, (parameters, parameters)."""
        return torch.cholesky_inverse(self.factor) / self.scale[:, None] / self.scale

    def whiten(self, shapes: torch.Tensor) -> torch.Tensor:
        return self.posterior.covariance.whiten(shapes)

    @cached_property
    def _deviations(self) -> torch.Tensor:
        """Frames minus their mean, whitened, (pixels, frames); their square is the covariance of the mean."""
        shapes = torch.where(self.stack.root > 0, self.stack.deviations / self.stack.root, 0.0)
        return self.whiten(shapes.mT) / math.sqrt((len(self.stack) - 1) * self.stack.independent)

    def covariance_of(self, left: torch.Tensor) -> torch.Tensor:
        """Of products of the mean with whitened shapes (pixels, m), where frames scatter more than C says."""
        gram = left.mT @ left
        if self.stack.held_out == "pixels":
            return gram
        scatter = ((left.mT @ self._deviations) ** 2).sum(1) / gram.diagonal().clamp_min(1e-300)
        return gram * float(scatter.mean().clamp_min(1.0))

    @property
    def alike_px(self) -> float:
        """Number of pixels that what a model misses changes alike: those of an Airy disc."""
        across_px = self.settings.resolution_mas / self.settings.pixel_scale_mas
        return max(1.0, np.pi / 4 * across_px**2)

    @cached_property
    def misfit(self) -> float:
        """χ²/ν with the error of the flat in the variances, and none of the model."""
        root = self.stack.with_errors(self.posterior.covariance.flat_rms).root
        white = (self.stack.mean_e - self.image) * root
        return float(white @ white) / self.fitted.problem.freedom

    def making_room(self, shape: torch.Tensor) -> torch.Tensor:
        """How parameters move that imitate a whitened shape (pixels,) where it is added, (parameters,)."""
        inside = torch.linalg.solve_triangular(self.factor.mT, (self.basis.mT @ shape)[:, None], upper=True)
        return -inside[:, 0] / self.scale

    def linear(self) -> Linear:
        """The model linear about the optimum."""
        return Linear(self.fitted, self.posterior, self.covariance, self.x[0])

    def null_of(self, linear: Linear) -> NullModel:
        """The null model of score tests where some of the effects are at nothing."""
        gone = {column for label in linear.gone for column in self.fitted.columns_of(label)}
        rows = [row for row in range(len(self.scale)) if row not in gone]
        move = linear.move
        factored = _factored(self.hessian[rows][:, rows])
        design = self.whiten(self.columns[rows].mT)
        residual = self.residual - self.whiten((self.columns.mT @ move)[:, None])[:, 0]
        precision = self.posterior.prior_precision[rows]
        force = design.mT @ residual - precision * (
            (self.x[0] + move)[rows] - self.posterior.prior_mean[rows]
        )
        unconverged, basis = _inside(*factored, force[None])[:, 0], _inside(*factored, design).mT
        return NullModel(residual, self.root, basis, unconverged)

    def with_best_law(self) -> WavefrontLaw:
        """The law of the modes by evidence, everything else marginalised linearly."""
        posterior = self.posterior
        nolls = np.asarray(posterior.exact.layout.nolls)
        ruled = np.zeros(self.x.shape[1], bool)
        ruled[: len(nolls)] = nolls > 4
        scale = self.scale.numpy()
        scaled = self.hessian.numpy() / np.outer(scale, scale)
        free = scaled[np.ix_(~ruled, ~ruled)] + 1e-12 * np.eye(int((~ruled).sum()))
        cross = np.linalg.solve(free, scaled[np.ix_(~ruled, ruled)])
        marginal = scaled[np.ix_(ruled, ruled)] - scaled[np.ix_(ruled, ~ruled)] @ cross
        marginal = marginal * np.outer(scale[ruled], scale[ruled])
        pull = marginal @ self.x[0].numpy()[ruled]
        curvature = marginal - np.diag(posterior.prior_precision.numpy()[ruled])

        def deviance(x: np.ndarray) -> float:
            own = posterior.law.changed(x).sigma_nm(nolls)[nolls > 4]
            try:
                factor = np.linalg.cholesky(curvature + np.diag(own**-2))
            except np.linalg.LinAlgError:
                return 1e300
            spread = 2 * np.log(np.diag(factor)).sum() + 2 * np.log(own).sum()
            expected = (((x - LAW_EXPECTED) / LAW_WIDTH) ** 2).sum()
            return float(spread - (np.linalg.solve(factor, pull) ** 2).sum() + expected)

        law = posterior.law
        start = np.array([math.log(law.scale), math.log(law.tail.amplitude_nm), law.tail.slope])
        options = {**LAW_TOLERANCES, "initial_simplex": start + LAW_SIMPLEX}
        return law.changed(minimize(deviance, start, method="Nelder-Mead", options=options).x)

    def with_best_errors(self) -> Covariance:
        """The covariance with the errors of model and flat by evidence, all parameters following linearly.

        The search goes from the best place of a grid to its neighbours.
        """
        own = self.posterior.covariance
        tried: dict[tuple[int, int], tuple[float, Covariance]] = {}

        def evaluated(place: tuple[int, int]) -> tuple[float, Covariance]:
            changed = own.with_errors(MODEL_ERRORS[place[0]], FLAT_ERRORS[place[1]])
            return self._log_evidence_under(changed), changed

        best = (MODEL_ERRORS.index(own.model_rms), FLAT_ERRORS.index(own.flat_rms))
        while True:
            near = [(best[0] + by[0], best[1] + by[1]) for by in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))]
            new = [(i, j) for i, j in near if i in range(len(MODEL_ERRORS)) and j in range(len(FLAT_ERRORS))]
            new = [place for place in new if place not in tried]
            if not new:
                return tried[best][1]
            tried |= zip(new, ordered_map(evaluated, new), strict=True)
            best = max(tried, key=lambda place: tried[place][0])

    def _log_evidence_under(self, covariance: Covariance) -> float:
        posterior, design = self.posterior, covariance.whiten(self.columns.mT)
        left = covariance.whiten((self.stack.mean_e - self.image)[:, None])[:, 0]
        factor, scale = _factored(posterior.hessian(design), 1e-12)
        ahead = _inside(factor, scale, posterior.gradient(self.x, design, left)[None])
        chi2 = float(left @ left) + posterior.penalty(self.x) - float((ahead**2).sum())
        volume = 2 * float(factor.diagonal().log().sum() + scale.log().sum())
        return 0.5 * (-chi2 - volume - covariance.log_determinant)


@dataclass(frozen=True, eq=False)
class Linear:
    """A model that is linear about the optimum of its posterior, some of its effects at nothing.

    Holding parameters b with estimates β at a distance from nothing moves the others by −C_ab C_bb⁻¹ β (Wald
    1943, Trans. AMS 54, 426): effects that imitate each other gain odds once one of them is gone.
    """

    fitted: Fitted
    posterior: Posterior
    covariance: torch.Tensor  # (parameters, parameters)
    x: torch.Tensor  # (parameters,)
    gone: tuple[str, ...] = ()

    @property
    def move(self) -> torch.Tensor:
        """Change of the parameters, (parameters,)."""
        return self.x - self.fitted.x[0]

    def nulls_of(self, label: str) -> dict[int, float]:
        """Values without effect of those parameters that have one, by column."""
        pairs = zip(self.fitted.columns_of(label), self.fitted.effect(label).parameters, strict=True)
        return {column: one.null for column, one in pairs if one.null is not None}

    def without(self, label: str) -> Linear:
        """The model with one effect more at nothing."""
        own, apart, inverse, held = self._from_nothing(label)
        gain = held[:, own] @ inverse
        left = held - gain @ held[own]
        return replace(self, covariance=left, x=self.x - gain @ apart, gone=(*self.gone, label))

    def rise_without(self, label: str) -> float:
        """Rise of χ² and priors without one effect more."""
        _, apart, inverse, _ = self._from_nothing(label)
        return float(apart @ inverse @ apart)

    def _from_nothing(self, label: str) -> tuple[list[int], torch.Tensor, torch.Tensor, torch.Tensor]:
        """Columns of an effect, their values from where it has no effect, and their inverse covariance.

        What is at nothing has no place or width: with these held is also the last, the covariance of all.
        """
        nulls = self.nulls_of(label)
        apart = self.x[[*nulls]] - torch.tensor([*nulls.values()], dtype=torch.float64)
        places = [column for column in self.fitted.columns_of(label) if column not in nulls]
        cross = self.covariance[:, places]
        held = self.covariance - cross @ _inverse(cross[places]) @ cross.mT
        return [*nulls], apart, _inverse(held[[*nulls]][:, [*nulls]]), held

    def log_odds(self, label: str) -> float:
        """ln odds of an effect against its absence (Dickey 1971, Ann. Math. Stat. 42, 204)."""
        nulls, own = self.nulls_of(label), self.fitted.columns_of(label)
        if not nulls:
            return math.inf
        # The priors of the effect count with it only: of sizes at nothing, of places where they are.
        without = [nulls.get(column, float(self.x[column])) for column in own]
        apart = torch.tensor(without, dtype=torch.float64) - self.posterior.prior_mean[own]
        precision = self.posterior.prior_precision[own]
        penalty = float((precision * apart**2).sum())
        spread = float(torch.linalg.slogdet(self.covariance[own][:, own])[1] + precision.log().sum())
        return 0.5 * (self.rise_without(label) - penalty + spread)


def _inverse(covariance: torch.Tensor) -> torch.Tensor:
    return torch.linalg.pinv(covariance, hermitian=True)


def fitted_as(
    problem: JointFit,
    solution: Solution,
    stack: Stacks,
    views: Sequence[View],
    image: torch.Tensor,
    columns: torch.Tensor,
) -> Fitted:
    """A model whose mean images and derivatives are known."""
    chi2 = float((((stack.mean_e - image) * stack.root) ** 2).sum())
    fitted = Fitted(problem, solution, chi2, views, complete=True)
    vars(fitted)["linearised"] = (image, columns)
    return fitted
