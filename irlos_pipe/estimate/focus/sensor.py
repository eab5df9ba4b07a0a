"""The focus sensor of a closed loop: one image in, defocus with its error and a verdict out.

Every image is measured by itself, from a scan of the whole reach on: no earlier image matters, so that a
measurement can be repeated, on line or afterwards, to the last bit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import DECISIVE
from irlos_pipe.estimate.focus.photon_fit import Candidate, FocusScan, Found, Noise, PhotonFit
from irlos_pipe.estimate.focus.unexplained import Unexplained, unexplained
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.estimate.tabulated import TILT_REACH_NM
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.solver import CONVERGED, INVALID, STALLED, Solution
from irlos_pipe.optics.focus_table import FocusImages, FocusTable, Reach, can_tabulate, is_family

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
