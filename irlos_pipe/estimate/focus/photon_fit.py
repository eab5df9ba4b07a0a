"""The maximum-likelihood fit of one image by tip, tilt, focus, flux and background.

The estimator is that of `lift` with variances that follow the model: the minimum of the quasi-likelihood of
`NoiseModel`, by Fisher scoring. With five parameters and one image the arithmetic is a few matrix products,
which NumPy does in memory that is set aside once.

It begins with a scan of defocus and position that needs no earlier image: as `starts.scan_start_nm`, the best
of some templates by normalised cross-correlation; but images have no frequencies beyond the optics' cut-off,
and a star in a closed loop lies within a few pixels of its place. A few frequencies and a few shifts are
left, and the correlation is two small matrix products.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.fft import rfft2

from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.estimate.starts import STEP_NM
from irlos_pipe.numerics.solver import CHI2_TOLERANCE
from irlos_pipe.optics.focus_table import FocusImages, FocusTable

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
