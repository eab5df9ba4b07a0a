"""Whether wavefront or image moved during the recording: estimates of single frames against time.

The mean image hardly shows a drift. One linear step from the common solution gives every frame its
coefficients; their slopes are judged by their own scatter about the straight line. A large drift leaves
the range of one linear step: the response of the step to images that drift as measured says by how much.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import chdtri, ndtr

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import gaussian_sigma, surely_exceeding
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.wavefront import NcpaDrift
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.solver import scaled_inverse

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
