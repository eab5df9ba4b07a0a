"""The focus sensor of a closed loop: one image in, defocus with its error and a verdict out.

Every image is measured by itself, from a scan of the whole reach on: no earlier image matters, so that a
measurement can be repeated, on line or afterwards, to the last bit.

It is fitted by tip, tilt, focus, flux and background. The estimator is that of `lift` with variances that
follow the model: the minimum of the quasi-likelihood of `NoiseModel`, by Fisher scoring. With five parameters
and one image the arithmetic is a few matrix products, which NumPy does in memory that is set aside once.

It begins with a scan of defocus and position that needs no earlier image: as `starts.scan_start_nm`, the best
of some templates by normalised cross-correlation; but images have no frequencies beyond the optics' cut-off,
and a star in a closed loop lies within a few pixels of its place. A few frequencies and a few shifts are
left, and the correlation is two small matrix products.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from scipy.fft import rfft2

from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import DECISIVE
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.estimate.starts import STEP_NM
from irlos_pipe.estimate.tabulated import TILT_REACH_NM
from irlos_pipe.estimate.unexplained import Unexplained, unexplained
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.solver import CHI2_TOLERANCE, CONVERGED, INVALID, STALLED, Solution
from irlos_pipe.optics.focus_table import FocusImages, FocusTable, Reach, can_tabulate, is_family

ITERATIONS = 20
HALVINGS = 6  # halvings, at most, of a step that would raise the objective
# Predicted fall over the rise that rounding may make, at which a stuck fit is done: a tenth of an error.
WITHIN_ROUNDING = 10.0


class Noise(NamedTuple):
    """``V = factor · signal + floor`` [e-²], see `NoiseModel`."""

    factor: float
    floor_e2: float


class Found(NamedTuple):
    """Where a fit ended."""

    x: np.ndarray  # (5,): tip, tilt, focus [nm RMS], flux, background [e-]
    covariance: np.ndarray  # (5, 5), inverse Fisher matrix
    objective: float  # minus the quasi-likelihood, up to a constant of the image
    chi2_nu: float
    # light that the model does not explain, beyond noise: RMS over the pixels, over that of the star
    misfit: float
    iterations: int
    converged: bool


class PhotonFit:
    """Fits of single images on `good` pixels (rows, columns), one after the other, in so many
    `iterations`."""

    def __init__(self, images: FocusImages, good: np.ndarray, iterations: int = ITERATIONS):
        self._iterations = iterations
        self._images, self._good = images, good.ravel().astype(np.float64)
        pixels = good.size
        self._freedom = max(1, int(good.sum()) - 5)
        self._slopes = np.ones((5, pixels), np.float32)
        self._weighted = np.empty((5, pixels), np.float32)
        self._model, self._residual, self._weight, self._scratch = np.empty((4, pixels))
        self._single_weight = np.empty(pixels, np.float32)

    def __call__(self, image_e: np.ndarray, start_nm: tuple[float, float, float], noise: Noise) -> Found:
        """Fit `image_e`, (rows · columns,) in float64 with finite bad pixels, from tip, tilt and focus."""
        x = np.array([*np.clip(start_nm, *self._images.limits_nm), 0.0, 0.0])
        self._images(*x[:3])
        x[3:] = self._brightness(image_e)
        value = self._compare(image_e, x, noise)
        for iteration in range(1, self._iterations + 1):
            gradient, fisher = self._equations(x)
            np.multiply(self._residual, self._residual, out=self._scratch)
            chi2_nu = float(self._scratch @ self._weight) / self._freedom
            step, gain = _scoring(gradient, fisher)
            if gain < CHI2_TOLERANCE * max(1.0, chi2_nu):
                end = self._bounded(x + step)
                return Found(end, _inverse(fisher), value, chi2_nu, self._misfit(x, noise), iteration, True)
            rise = CHI2_TOLERANCE * max(1.0, chi2_nu)  # of rounding: images are of single precision
            trial, lower = self._descend(image_e, x, step, value + rise, noise)
            if trial is None:
                break
            x, value = trial, lower
        done = trial is None and gain < WITHIN_ROUNDING * rise  # no fall can be seen that is so small
        return Found(x, _inverse(fisher), value, chi2_nu, self._misfit(x, noise), iteration, done)

    def _descend(self, image_e, x, step, highest, noise) -> tuple[np.ndarray | None, float]:
        """The point after a step, halved until the objective is not above `highest`, and the objective."""
        for _ in range(HALVINGS):
            trial = self._bounded(x + step)
            self._images(*trial[:3])
            lower = self._compare(image_e, trial, noise)
            if lower <= highest:
                return trial, lower
            step = step / 2
        return None, highest

    def _bounded(self, x: np.ndarray) -> np.ndarray:
        x[:3] = np.clip(x[:3], *self._images.limits_nm)
        return x

    def _brightness(self, image_e: np.ndarray) -> np.ndarray:
        """Flux and background by least squares, the wavefront being that of the last images."""
        good, unit = self._good, np.multiply(self._images.image, self._good, out=self._scratch)
        across = unit.sum()
        normal = np.array([[unit @ self._images.image, across], [across, good.sum()]])
        return np.linalg.solve(normal, [unit @ image_e, good @ image_e])

    def _compare(self, image_e: np.ndarray, x: np.ndarray, noise: Noise) -> float:
        """Objective of the last images; slopes, residuals and weights are kept."""
        images, model, scratch = self._images, self._model, self._scratch
        np.multiply(images.image, x[3], out=model, dtype=np.float64)
        model += x[4]
        np.subtract(image_e, model, out=self._residual)
        positive = np.maximum(model, 0.0, out=scratch)
        np.multiply(positive, noise.factor, out=self._weight)
        self._weight += noise.floor_e2
        np.divide(self._good, self._weight, out=self._weight)
        return float(_minus_quasi_likelihood(image_e, model, positive, noise) @ self._good)

    def _equations(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient of the objective and Fisher matrix where images were compared last."""
        np.multiply(self._images.slopes, np.float32(x[3]), out=self._slopes[:3])
        self._slopes[3] = self._images.image
        self._single_weight[:] = self._weight
        np.multiply(self._slopes, self._single_weight, out=self._weighted)
        fisher = (self._weighted @ self._slopes.T).astype(np.float64)
        return -(self._weighted @ self._residual), fisher

    def _misfit(self, x: np.ndarray, noise: Noise) -> float:
        positive = np.maximum(self._model, 0.0, out=self._scratch)
        expected = noise.factor * (positive @ self._good) + noise.floor_e2 * self._good.sum()
        residual = self._residual * self._good
        star = self._images.image * self._good
        light = x[3] ** 2 * float(star @ star)
        return float(np.sqrt(max(residual @ residual - expected, 0.0) / max(light, 1e-300)))


def _minus_quasi_likelihood(
    image_e: np.ndarray, model_e: np.ndarray, positive_e: np.ndarray, noise: Noise
) -> np.ndarray:
    """See `NoiseModel.minus_quasi_likelihood`; `positive_e` is the model without what lies below 0."""
    factor, floor = noise
    growth = np.log1p(positive_e * (factor / floor))
    growth *= image_e + floor / factor
    pixels = (positive_e - growth) / factor
    below = model_e - positive_e
    return pixels + (0.5 * below - image_e) * below / floor


def _scoring(gradient: np.ndarray, fisher: np.ndarray) -> tuple[np.ndarray, float]:
    """Step of Fisher scoring, and twice the fall of the objective that it promises."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(fisher), 1e-300))
    scaled = fisher * scale * scale[:, None]
    scaled.flat[::6] += 1e-9
    step = -np.linalg.solve(scaled, gradient * scale) * scale
    return step, float(-gradient @ step)


def _inverse(fisher: np.ndarray) -> np.ndarray:
    scale = 1 / np.sqrt(np.maximum(np.diagonal(fisher), 1e-300))
    return np.linalg.pinv(fisher * scale * scale[:, None], hermitian=True) * scale * scale[:, None]


APART = 2  # templates on either side, among which a maximum must be the highest
CUT = 0.4  # frequencies kept [cycles/px]: more than a table's images have


class Candidate(NamedTuple):
    """A maximum of the correlation; it lies between the templates and shifts [nm RMS]."""

    tip_nm: float
    tilt_nm: float
    focus_nm: float
    energy_e2: float  # by how much the template, at its best brightness, lowers the sum of squares [e-²]


class FocusScan:
    """Templates of a `FocusTable` over its whole reach."""

    def __init__(self, table: FocusTable):
        low, high = table.reach.focus_nm
        self._focus_nm = np.linspace(low, high, int(np.ceil((high - low) / STEP_NM)) + 1)[1:-1]
        modes_nm = torch.zeros(len(self._focus_nm), 3, dtype=torch.float64)
        modes_nm[:, table.focus] = torch.as_tensor(self._focus_nm)
        rows, columns = table.settings.window
        self._kept = np.abs(np.fft.fftfreq(rows)) <= CUT, np.fft.rfftfreq(columns) <= CUT
        spectra = np.conj(self._spectrum(table.images(modes_nm).cpu().numpy()))
        count = np.where(np.fft.rfftfreq(columns)[self._kept[1]] > 0, 2.0, 1.0) / (rows * columns)
        norm = np.sqrt((np.abs(spectra) ** 2 * count).sum((1, 2), keepdims=True))
        self._spectra = (spectra / norm * count).astype(np.complex64)
        settings = table.settings
        self._pixel_nm = tilt_nm(settings.pixel_scale_mas, settings.geometry.diameter_m)
        shifts = int(np.ceil(table.reach.tilt_nm / self._pixel_nm))
        self._shifts = np.arange(-shifts, shifts + 1)
        along_y = np.fft.fftfreq(rows)[self._kept[0]]
        along_x = np.fft.rfftfreq(columns)[self._kept[1]]
        self._to_rows = np.exp(2j * np.pi * np.outer(self._shifts, along_y)).astype(np.complex64)
        self._to_columns = np.exp(2j * np.pi * np.outer(along_x, self._shifts)).astype(np.complex64)

    def __call__(self, image_e: np.ndarray) -> list[Candidate]:
        """Return the maxima along the focus, the highest first; bad pixels of `image_e` must be harmless."""
        products = self._spectra * self._spectrum(image_e)
        along_x = (products.reshape(-1, products.shape[2]) @ self._to_columns).reshape(
            *products.shape[:2], -1
        )
        correlation = np.matmul(self._to_rows, along_x).real
        peaks = correlation.max((1, 2))
        return [self._candidate(correlation, peaks, one) for one in _maxima(peaks)]

    def _spectrum(self, images: np.ndarray) -> np.ndarray:
        """Frequencies kept, without the mean, complex64."""
        spectrum = rfft2(images.astype(np.float32, copy=False))[..., self._kept[0], :][..., self._kept[1]]
        spectrum[..., 0, 0] = 0
        return spectrum

    def _candidate(self, correlation: np.ndarray, peaks: np.ndarray, index: int) -> Candidate:
        row, column = np.unravel_index(correlation[index].argmax(), correlation.shape[1:])
        step = self._focus_nm[1] - self._focus_nm[0]
        return Candidate(
            float((self._shifts[column] + _vertex(correlation[index, row], column)) * self._pixel_nm),
            float((self._shifts[row] + _vertex(correlation[index, :, column], row)) * self._pixel_nm),
            float(self._focus_nm[index] + _vertex(peaks, index) * step),
            float(max(peaks[index], 0.0)) ** 2,
        )


def _maxima(peaks: np.ndarray) -> list[int]:
    """Positions that nothing within `APART` exceeds, the highest first."""
    found: list[int] = []
    for index in np.argsort(peaks)[::-1]:
        near = peaks[max(0, index - APART) : index + APART + 1]
        if peaks[index] == near.max():
            found.append(int(index))
    return found


def _vertex(values: np.ndarray, index: int) -> float:
    """Vertex of the parabola through a maximum and its neighbours, from the maximum [steps]; 0 at an end."""
    if index in (0, len(values) - 1):
        return 0.0
    before, here, after = values[index - 1 : index + 2]
    bend = before - 2 * here + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


REACH_NM = 1000.0  # of defocus either way: images up to 900 nm have a template and room on both sides
ROUGHLY_DECISIVE = 60.0  # Δχ² of the scan from which another maximum needs no fit of its own
RIVALS = 3  # other maxima that are tried, at most, where the first is wrong
# A misfit below which images are not tried in other orientations, and the part of χ²/ν to which one of these
# must bring it. Images read out transposed or flipped have a misfit of a tenth and more, and one orientation
# in which χ²/ν is a ninth or less. In a seeing burst right images have such a misfit, too, and no better
# orientation; of wrong ones it then brings χ²/ν to a quarter, near the focus only to a half.
UPRIGHT_MISFIT, UPRIGHT_PART = 0.08, 0.5
TURNED_ITERATIONS = 3  # a fit of the right orientation is near its end, and of wrong ones there are many
ABSURD_E = 1e12  # of a pixel, either way: no detector gives it, and single precision has room for its square

# Reasons why a measurement is not to be used.
NOT_FINITE, SATURATED, NOT_CONVERGED = "not_finite", "saturated", "not_converged"
LOST_STAR, RANGE, CHI2, TWIN, UNCERTAIN = "lost_star", "range", "chi2", "twin", "uncertain"
MIRRORED = "mirrored"


@dataclass(frozen=True)
class Limits:
    """What a measurement must satisfy to be used."""

    # Largest χ² per degree of freedom, and part of the light that the model may leave unexplained; a solution
    # that exceeds both is wrong. The light of speckles, significant on a bright star, is a tenth; that of a
    # wrong minimum more than a half.
    chi2_nu: float = 2.0
    misfit: float = 0.3
    # least flux over its error: noise alone, free to move over the scan, reaches 5
    signal_to_noise: float = 8.0
    sigma_nm: float = 100.0  # largest formal error of the defocus [nm RMS]
    evidence: float = DECISIVE  # Δχ² by which the best solution must surpass any other one
    saturation_e: float = math.inf  # of the brightest good pixel of one read


class Measurement(NamedTuple):
    """Of one image; numbers are NaN where there was nothing to fit."""

    defocus_nm: float  # beyond the known wavefront [nm RMS]
    sigma_nm: float  # from photons and read-out [nm RMS]
    valid: bool  # whether there are no `reasons` against it
    reasons: tuple[str, ...] = ()
    tip_nm: float = math.nan
    tilt_nm: float = math.nan
    flux_e: float = math.nan  # through the clear pupil
    background_e: float = math.nan  # per pixel
    chi2_nu: float = math.nan  # as `misfit`, see `Found`
    misfit: float = math.nan
    iterations: int = 0
    beside: Unexplained | None = None  # what the model does not explain of the image


class Focus:
    """Measures tip, tilt and defocus of single images with one model.

    Everything is prepared here; a measurement takes about a millisecond on one core. One object serves one
    thread. The `model` has the modes tip, tilt and defocus, in whatever order; its effects have no free
    parameters and none acts on the detector or changes with time. The `good` pixels are (rows, columns), the
    `noise` is that of one read. Raises ValueError if the images of such a model cannot be tabulated.
    """

    def __init__(
        self,
        model: ImageModel,
        good: np.ndarray,
        noise: NoiseModel,
        limits: Limits = Limits(),
    ):
        reach = Reach((-REACH_NM, REACH_NM), TILT_REACH_NM)
        _require_table(model, reach)
        table = FocusTable(model.psf, model.optics, reach)
        self.window, self.limits, self.noise = table.settings.window, limits, noise
        self._good = np.asarray(good, bool)
        self._bad = ~self._good.ravel()
        self._images = FocusImages(table)
        self._scan, self._fit = FocusScan(table), PhotonFit(self._images, self._good)
        self._image = np.empty(self._good.shape)
        self._turned = [
            (turn, PhotonFit(self._images, turn.of(self._good), TURNED_ITERATIONS))
            for turn in _turns(self.window)
        ]

    def measurement(self, image_e: np.ndarray, reads: int = 1) -> Measurement:
        """Measure one image, the sum of some `reads`, whose read noise adds.

        The image (rows, columns) is of photo-electrons without background and dark, infinite where saturated.
        Raises ValueError for an image of another window.
        """
        measured, found = self.solved(image_e, reads)
        if found is None or LOST_STAR in measured.reasons:
            return measured
        return measured._replace(beside=self.beside(found, reads))

    def beside(self, found: Found, reads: int = 1) -> Unexplained:
        """Take apart what `found`, the solution of the last sum of some `reads`, does not explain."""
        model_e = self.model_e(found)
        slopes_e = self._images.slopes[:3] * found.x[3]
        noise = self._noise_of(reads)
        return unexplained(self._image - model_e, model_e - found.x[4], slopes_e, self._good, *noise)

    def solved(self, image_e: np.ndarray, reads: int = 1) -> tuple[Measurement, Found | None]:
        """Return the measurement and the whole solution; `image_e` and `reads` as in `measurement`."""
        if np.shape(image_e) != self.window:
            raise ValueError(f"image of {np.shape(image_e)} pixels; this sensor is for {self.window}")
        self._image[...] = image_e
        flat = self._image.ravel()
        flat[self._bad] = 0.0
        peak_e = float(np.abs(flat).max())
        if not peak_e < ABSURD_E:  # NaN is none, either
            reason = SATURATED if peak_e == math.inf else NOT_FINITE
            return Measurement(math.nan, math.nan, False, (reason,)), None
        noise = self._noise_of(reads)
        best, rival = self._best(flat, noise)
        return self._judged(best, rival, float(flat.max()) / reads, noise), best

    def _noise_of(self, reads: int) -> Noise:
        """Of the sum of some reads."""
        floor_e2 = self.noise.floor_e2 * reads + self.noise.shared_e2 * reads**2
        return Noise(self.noise.excess_noise_factor, floor_e2)

    def model_e(self, found: Found) -> np.ndarray:
        """Return the image of a solution, (rows, columns) [e-]."""
        self._images(*found.x[:3])
        return (found.x[3] * self._images.image.astype(float) + found.x[4]).reshape(self.window)

    def _best(self, flat: np.ndarray, noise: Noise) -> tuple[Found, float]:
        """The best solution, and the Δχ² of the next."""
        candidates = self._scan(self._image)
        found = [self._fit(flat, candidates[0][:3], noise)]
        found += [self._fit(flat, one[:3], noise) for one in self._rivals(candidates, found[0], noise)]
        found.sort(key=lambda one: (not one.converged, one.objective))
        apart = [one for one in found[1:] if abs(one.x[2] - found[0].x[2]) > 5 * _sigma_nm(one) + 1.0]
        return found[0], min((2 * (one.objective - found[0].objective) for one in apart), default=math.inf)

    def _rivals(self, candidates: list[Candidate], first: Found, noise: Noise) -> list[Candidate]:
        """Further maxima of the scan: the next if it cannot be excluded, several if the first fit failed.

        None where there is no star. The scan weights all pixels equally; its Δχ² is that of the mean variance
        of the pixels with light.
        """
        others = candidates[1 : 1 + RIVALS]
        if candidates[0].energy_e2 < self.limits.signal_to_noise**2 * noise.floor_e2:
            return []
        if not first.converged or self._is_wrong(first):
            return others
        light_e = first.x[3] * self._images.image
        squares = float(light_e @ light_e)
        variance = noise.factor * float(light_e**2 @ light_e) / max(squares, 1e-300) + noise.floor_e2
        least = candidates[0].energy_e2 - ROUGHLY_DECISIVE * variance
        return [one for one in others[:1] if one.energy_e2 > least]

    def _judged(self, found: Found, rival: float, peak_e: float, noise: Noise) -> Measurement:
        """A solution with everything that speaks against it."""
        limits, x, sigma_nm = self.limits, found.x, _sigma_nm(found)
        low, high = self._images.limits_nm
        flux_sigma_e = math.sqrt(max(found.covariance[3, 3], 0.0))
        against = {
            SATURATED: peak_e >= limits.saturation_e,
            NOT_CONVERGED: not found.converged,
            LOST_STAR: not x[3] > limits.signal_to_noise * flux_sigma_e,
            RANGE: bool(((x[:3] <= low) | (x[:3] >= high)).any()),
            CHI2: self._is_wrong(found),
            MIRRORED: self._is_mirrored(found, noise),
            TWIN: rival < limits.evidence,
            UNCERTAIN: not sigma_nm <= limits.sigma_nm,
        }
        reasons = tuple(reason for reason, holds in against.items() if holds)
        tip, tilt, focus, flux, background = x.tolist()
        fit = found.chi2_nu, found.misfit, found.iterations
        return Measurement(focus, sigma_nm, not reasons, reasons, tip, tilt, flux, background, *fit)

    def _is_wrong(self, found: Found) -> bool:
        return not (found.chi2_nu <= self.limits.chi2_nu or found.misfit <= self.limits.misfit)

    def _is_mirrored(self, found: Found, noise: Noise) -> bool:
        """Whether the image, where the model does not explain it, is explained flipped or turned."""
        if found.chi2_nu <= self.limits.chi2_nu or found.misfit <= UPRIGHT_MISFIT:
            return False
        for turn, fit in self._turned:
            image = turn.of(self._image)
            other = fit(image.ravel(), self._scan(image)[0][:3], noise)
            if other.chi2_nu < UPRIGHT_PART * found.chi2_nu:
                return True
        return False


class _Turn(NamedTuple):
    """How a detector may be read out otherwise."""

    transposed: bool
    rows: int
    columns: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """Return an image so read out."""
        image = image.T if self.transposed else image
        return np.ascontiguousarray(image[:: self.rows, :: self.columns])


def _turns(window: tuple[int, int]) -> list[_Turn]:
    """All other orientations; only those of a square window may be transposed."""
    transposed = (False, True) if window[0] == window[1] else (False,)
    return [_Turn(*one) for one in product(transposed, (1, -1), (1, -1))][1:]


def _sigma_nm(found: Found) -> float:
    return math.sqrt(max(found.covariance[2, 2], 0.0))


def _require_table(model: ImageModel, reach: Reach) -> None:
    if not is_family(model.psf.nolls) or 4 not in model.psf.nolls:
        raise ValueError(f"modes {model.psf.nolls}: a focus sensor measures Noll 2, 3 and 4")
    if model.effects.parameters or model.effects.at("time") or model.effects.at("detector"):
        raise ValueError("effects of the detector, of time, or with free parameters: images have no table")
    if not can_tabulate(model.psf, model.optics, reach):
        raise ValueError("the images are sampled too coarsely, or the field around them is too small")


NOLLS = (2, 3, 4)
PARAMETERS = 5


def lift_singly(
    focus: Focus, images_e: np.ndarray, report: Callable[[int], object] = lambda count: None
) -> LiftResult:
    """Measure each of `images_e` (images, rows, columns) by itself; `report` gets a 1 after every image."""
    count = len(images_e)
    values, covariance = (
        np.full((count, PARAMETERS), np.nan),
        np.full((count, PARAMETERS, PARAMETERS), np.nan),
    )
    objective, chi2_nu = np.full((2, count), np.nan)
    iterations, status = np.zeros(count, np.int64), [INVALID] * count
    model_e = np.zeros(images_e.shape)
    for index, image in enumerate(images_e):
        _, found = focus.solved(image)
        if found is not None:
            values[index], covariance[index] = found.x, found.covariance
            objective[index], chi2_nu[index] = found.objective, found.chi2_nu
            iterations[index], status[index] = found.iterations, CONVERGED if found.converged else STALLED
            model_e[index] = focus.model_e(found)
        report(1)
    x, errors, counts, least = map(torch.from_numpy, (values, covariance, iterations, objective))
    solution = Solution(x, errors, status, counts, least)
    return LiftResult(NOLLS, solution, torch.from_numpy(model_e), torch.from_numpy(chi2_nu))
