"""The frames of a calibration cube: where the star is in each, and how well their mean is known.

The star may move from frame to frame. Frames are moved by whole pixels, which keeps their noise as it is.
What remains, half a pixel at most, is taken out of their signal alone: every frame i gets ``T(0) - T(δ_i)``,
the mean image T of the steady frames at rest less the same displaced by the rest δ_i of its place; T follows
by iteration from the mean of frames so corrected. An image whose pixels sample it (λ/D ≥ 2 px) is displaced
by a phase in its spectrum; of coarser pixels the rest stays in the frames, as image motion.

Frames may be a mixture of two kinds: stars, pointings, wavefronts. A mixture scatters by more than its parts,
so that its scatter excuses what a single model misfits. But it does not scatter as noise does: along the
direction in which most of the variance lies, frames of two kinds sit at two values. Their kurtosis is 1 for
halves, 3 for Gaussian scatter and 1.5 for a sinusoidal vibration. Differences in brightness do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
import torch
from scipy.special import chdtri

from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import blocks, frame_flux, frame_variance, mean_frame, sample_frames
from irlos_pipe.frames.screening import star_peaks

# Frames from which their scatter gives the error of the mean; of fewer, the noise model does.
FRAMES_OF_SCATTER = 16
LEAST_FRAMES = 4  # frames from which their scatter is considered
LOCAL_PX = 5  # side of the square over which scatter is averaged


@dataclass(frozen=True)
class Frames:
    """Images of a calibration cube."""

    images_e: torch.Tensor  # (frames, rows, columns)
    good: torch.Tensor  # (rows, columns)
    noise: NoiseModel
    # by which the variance of the mean is larger because a model misfits, see `few_frames`
    misfit: float = 1.0
    light_error: float = 0.0  # part of the light around a pixel by which flat and model err there
    motion: Motion | None = None  # of the star before the frames were `steadied`; None where it did not move

    @cached_property
    def mean_e(self) -> torch.Tensor:
        """Mean image, (rows, columns), float64."""
        return torch.from_numpy(mean_frame(self.images_e.numpy()))

    @cached_property
    def scatter_e2(self) -> torch.Tensor:
        """Sample variance between the images, (rows, columns), float64."""
        return torch.from_numpy(frame_variance(self.images_e.numpy(), self.mean_e.numpy()))

    @cached_property
    def noise_ratio(self) -> float:
        """Scatter between the frames over the noise as declared, median of the pixels; NaN of a single frame.

        Speckles and image motion add to the noise, nothing takes from it: a ratio well below 1 contradicts
        gain or read noise. The median of a sample variance is less than its mean, by half of two frames.
        """
        freedom = len(self.images_e) - 1
        if freedom < 1:
            return float("nan")
        ratio = self.scatter_e2 / self.noise.scatter_e2(self.mean_e)
        return float(ratio[self.good].nanmedian()) * freedom / float(chdtri(freedom, 0.5))

    @property
    def show_scatter(self) -> bool:
        """Whether the frames are enough for their scatter to give the errors of their mean."""
        return len(self.images_e) >= FRAMES_OF_SCATTER

    @property
    def flux_e(self) -> torch.Tensor:
        """Signal of each image, (frames,), float64."""
        return torch.from_numpy(frame_flux(self.images_e.numpy()))

    @property
    def sample_e(self) -> torch.Tensor:
        """A few of the images, spread evenly, (some frames, pixels), float64."""
        chosen = torch.as_tensor(sample_frames(len(self.images_e)))
        return self.images_e[chosen].flatten(1).double()

    @property
    def root(self) -> torch.Tensor:
        """One over the standard errors of the mean image, 0 where it is not known, (pixels,)."""
        variance = mean_variance_e2(self).flatten()
        return torch.where(self.good.flatten() & torch.isfinite(variance), variance**-0.5, 0.0)

    def responses(self, gain: torch.Tensor) -> torch.Tensor:
        """Return what `gain` (parameters, pixels) makes of every image less the mean, (frames, parameters).

        All images have the flux of the mean one.
        """
        images, mean, flux = self.images_e.flatten(1), self.mean_e.flatten(), self.flux_e[:, None]
        series = torch.empty(len(images), len(gain), dtype=torch.float64)
        for block in blocks(len(images)):
            series[block] = (images[block] * (flux.mean() / flux[block]) - mean) @ gain.mT
        return series


def mean_variance_e2(frames: Frames) -> torch.Tensor:
    """Variance of the mean image [e-²], (rows, columns): the scatter between frames, and what they share.

    The ratio of scatter to photon noise is averaged over 5×5 pixels, about λ/D, before it is held
    above one: pixel by pixel, scatter from few frames is uncertain, and its excursions would raise
    the variance and lower χ². A single frame has no scatter: its noise is that of the noise model.
    """
    photons = frames.noise.scatter_e2(frames.mean_e)
    light = local_mean(frames.mean_e, frames.good.double()) if frames.light_error else 0.0
    model_e2 = (frames.light_error * light) ** 2
    if len(frames.images_e) == 1:
        return frames.misfit * (photons + frames.noise.shared_e2) + model_e2
    ratio = local_mean(frames.scatter_e2 / photons, frames.good.double())
    own = photons * ratio.clamp_min(1.0) / len(frames.images_e)
    return frames.misfit * (own + frames.noise.shared_e2) + model_e2


def local_mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Average `values` by `weight` over `LOCAL_PX` × `LOCAL_PX` pixels, (rows, columns)."""
    kernel = torch.ones(1, 1, LOCAL_PX, LOCAL_PX, dtype=values.dtype)
    total, norm = (
        torch.nn.functional.conv2d(plane[None, None], kernel, padding=LOCAL_PX // 2)[0, 0]
        for plane in (torch.where(weight > 0, values * weight, 0.0), weight)
    )
    return total / norm.clamp_min(1.0)


def autocorrelation_time(series: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of every column, in frames, (columns,).

    ``τ = 1 + 2 Σ ρ(l)`` of `series` (frames, columns), summed in pairs of lags until a pair is no longer
    positive (initial positive sequence, Geyer 1992, Stat. Sci. 7, 473); at least 1.
    """
    frames = len(series)
    if frames < LEAST_FRAMES:
        return np.ones(series.shape[1])
    centred = series - series.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centred, n=2 * frames, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:frames]
    rho = covariance / np.where(covariance[0] > 0, covariance[0], 1)
    pairs = rho[1:-1:2][: frames // 4] + rho[2::2][: frames // 4]
    positive = np.cumprod(pairs > 0, axis=0)
    return np.maximum(1 + 2 * np.sum(pairs * positive, axis=0), 1)


def covariance_of_mean(series: np.ndarray) -> np.ndarray:
    """Return the covariance of the mean, (columns, columns), of correlated `series` (frames, columns).

    The sample covariance over N, each column's error inflated by the root of its autocorrelation time. Raises
    ValueError with fewer than two rows.
    """
    if len(series) < 2:
        raise ValueError("the scatter of a mean needs at least two frames")
    inflation = np.sqrt(autocorrelation_time(series))
    covariance = np.atleast_2d(np.cov(series, rowvar=False)) / len(series)
    return covariance * inflation[:, None] * inflation[None, :]


FRAMES_OF_A_KIND = 20  # Gaussian scatter of so many has a kurtosis below 1.3 in one of 100 000 cubes
FEWEST_OF_A_KIND = 6  # from so many two kinds in halves, which have 1, are no chance
# By which it exceeds 1 at most; where fewer than `FRAMES_OF_A_KIND` tell, times their part squared.
CLEAR = 0.3
LEADING = 0.3  # part of the variance from which a single direction is examined


def kurtosis_of_frames(frames: Frames) -> float:
    """Return the kurtosis of the frames along the direction in which they differ most.

    NaN where no direction leads, and of fewer than `FRAMES_OF_A_KIND` unless they clearly are of two kinds:
    by chance Gaussian scatter is taken for that in one of 5000 cubes at most.
    """
    some = frames.sample_e
    if len(some) < FEWEST_OF_A_KIND:
        return float("nan")
    variance = mean_variance_e2(frames).flatten()
    usable = frames.good.flatten() & torch.isfinite(variance) & torch.isfinite(some).all(0)
    whitened = ((some - some.mean(0)) * variance**-0.5)[:, usable]
    star = (some.mean(0) * variance**-0.5)[usable]
    whitened -= (whitened @ star)[:, None] * (star / (star @ star))  # clouds dim the same star
    values, vectors = np.linalg.eigh((whitened @ whitened.mT).numpy())
    if not values[-1] > LEADING * values.sum():
        return float("nan")
    along = vectors[:, -1] - vectors[:, -1].mean()
    kurtosis = float(len(along) * np.sum(along**4) / np.sum(along**2) ** 2)
    clear = kurtosis < 1 + CLEAR * (len(some) / FRAMES_OF_A_KIND) ** 2
    return kurtosis if clear or len(some) >= FRAMES_OF_A_KIND else float("nan")


# RMS motion in λ/D up to which frames stay as they are. The part of the OTF by which motion of this size
# differs from a Gaussian one of the same variance is (2π · 0.1 · ½)⁴ / 24 at most, 4e-4 at half the cut-off.
STILL = 0.1
SAMPLED_PX = 2.0  # pixels per λ/D from which the image is sampled
# Frequencies kept, over the cut-off at the mean wavelength: bands reach further on their blue side.
PASSED = 1.1
SHOWN = 8.0  # peak over noise from which a frame shows where the star is
ROUNDS = 3  # rounds of template and places, and of the mean image at rest; each gains a digit
SEEN = 0.75  # part of the frames that must show a pixel; in the others the mean stands in its place
ORDERED = 0.8  # part of the variance of the places that a drift or a step must explain to be named


@dataclass(frozen=True)
class Motion:
    """Places of the star in the frames of a cube."""

    places_px: np.ndarray  # (frames, 2), (x, y) from their mean
    error_px: float  # standard error of a place, of one coordinate

    @property
    def rest_px(self) -> np.ndarray:
        """The place (x, y) at which the frames are steadied: that from which whole pixels leave the least.

        It is the mean of the places as phases of a pixel.
        """
        return np.angle(np.exp(2j * np.pi * self.places_px).mean(axis=0)) / (2 * np.pi)

    @property
    def displaced_px(self) -> np.ndarray:
        """Places from there, (frames, 2)."""
        return self.places_px - self.rest_px

    @property
    def rms_px(self) -> float:
        """RMS motion beyond the errors, of the coordinate along which it is larger."""
        return float(np.sqrt(max(0.0, self.places_px.var(axis=0).max() - self.error_px**2)))

    @property
    def largest_px(self) -> float:
        """Largest distance between two places along one coordinate."""
        return float(np.ptp(self.places_px, axis=0).max())

    @property
    def course(self) -> str:
        """How the star moves, in words."""
        count = np.arange(len(self.places_px))
        total = np.square(self.places_px).sum()
        time = count - count.mean()
        drift = np.square(time @ self.places_px).sum() / np.square(time).sum() / total
        before = np.square(np.cumsum(self.places_px, axis=0)[:-1]).sum(axis=1)
        steps = before * (1 / count[1:] + 1 / count[:0:-1]) / total  # Σ² (1/n + 1/(N - n)) for a step at n
        if max(drift, steps.max()) < ORDERED:
            return "moves from frame to frame"
        return "drifts" if drift >= steps.max() else f"jumps after frame {int(steps.argmax()) + 1}"


def steadied(
    images_e: np.ndarray, good: np.ndarray, noise: NoiseModel, resolution_px: float
) -> tuple[np.ndarray, np.ndarray, Motion | None]:
    """Return the frames with the star at one place, within half a pixel of the mean one, if it moves.

    λ/D has `resolution_px` pixels. Where the star does not move, `images_e` (frames, rows, columns) and
    `good` (rows, columns) are those given, and there is no motion.
    """
    motion = _motion(images_e, good, noise, STILL * resolution_px) if len(images_e) > 1 else None
    if motion is None:
        return images_e, good, None
    whole = np.rint(motion.displaced_px).astype(int)
    moved, seen = _moved_back(images_e, whole), _moved_back(np.broadcast_to(good, images_e.shape), whole)
    count = seen.sum(axis=0)
    rest = motion.displaced_px - whole if resolution_px >= SAMPLED_PX else np.zeros(whole.shape)
    template = np.where(count > 0, np.where(seen, moved, 0).sum(axis=0) / np.maximum(count, 1), 0)
    for _ in range(ROUNDS):
        at_rest = np.where(seen, moved + _differences(template, rest, resolution_px), template)
        template = mean_frame(at_rest)
    return at_rest.astype(images_e.dtype), count >= SEEN * len(images_e), motion


def _motion(images_e: np.ndarray, good: np.ndarray, noise: NoiseModel, negligible_px: float) -> Motion | None:
    """Places of the star, or None if they are not shown, or their RMS is `negligible_px` at most."""
    snr = star_peaks(np.where(good, images_e, 0)).snr
    typical = int(np.argsort(snr)[len(snr) // 2])
    if snr[typical] < SHOWN:
        return None
    one = images_e[typical]
    spectrum = scipy.fft.rfft2(np.where(good, one - np.median(one[good]), 0))
    for turn in range(ROUNDS):
        places, spectrum = _correlated(images_e, good, spectrum, steps=2 * (turn + 1))
        if places.std(axis=0).max() <= negligible_px / 2:
            return None
    mean = scipy.fft.irfft2(spectrum, good.shape)
    slopes = np.square(np.gradient(mean))
    errors = np.sqrt((slopes * noise.scatter_e2(mean)).sum(axis=(1, 2))) / slopes.sum(axis=(1, 2))
    motion = Motion(places, float(errors.max()))
    return motion if motion.rms_px > negligible_px else None


def _correlated(
    images: np.ndarray, good: np.ndarray, template: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places (x, y) of images where they correlate best with a template, and the mean of them moved back.

    The best pixel is followed by Newton steps. Template and mean are spectra; places are from their mean.
    """
    rows, columns = good.shape
    fy, fx = _frequencies(good.shape)
    twice = np.where((fx == 0) | (fx == np.pi), 1.0, 2.0)  # columns that stand for two in half a spectrum
    found, total = np.empty((len(images), 2)), np.zeros_like(template, complex)
    for block in blocks(len(images)):
        level = np.median(images[block][:, good], axis=1)[:, None, None]
        spectra = scipy.fft.rfft2(np.where(good, images[block] - level, 0))
        cross = spectra * np.conj(template)
        best = scipy.fft.irfft2(cross, good.shape).reshape(len(cross), -1).argmax(axis=1)
        y, x = np.unravel_index(best, good.shape)
        places = np.stack([_from_zero(x, columns), _from_zero(y, rows)], axis=1).astype(float)
        for _ in range(steps):
            at = twice * cross * _phases(fy, fx, places)
            gradient = -np.stack([(f * at.imag).sum((1, 2)) for f in (fx, fy)], axis=1)
            xx, yy, xy = (-(factor * at.real).sum((1, 2)) for factor in (fx**2, fy**2, fx * fy))
            hessian = np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1)
            places -= np.clip(np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0], -0.5, 0.5)
        found[block] = places
        total += (spectra * _phases(fy, fx, places)).sum(axis=0)
    middle = found.mean(axis=0)
    return found - middle, total * _phases(fy, fx, -middle[None])[0] / len(images)


def _from_zero(index: np.ndarray, size: int) -> np.ndarray:
    """Displacements of a periodic correlation, the smaller of the two that an index stands for."""
    return (index + size // 2) % size - size // 2


def _moved_back(images: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Images moved back by whole pixels (x, y); 0 where nothing was recorded."""
    moved = np.zeros(images.shape, images.dtype)
    rows, columns = images.shape[1:]
    for one, image, (x, y) in zip(moved, images, whole.tolist(), strict=True):
        one[max(0, -y) : rows - max(0, y), max(0, -x) : columns - max(0, x)] = image[
            max(0, y) : rows + min(0, y), max(0, x) : columns + min(0, x)
        ]
    return moved


def _differences(template: np.ndarray, rest: np.ndarray, resolution_px: float) -> np.ndarray:
    """Template at rest less the same displaced by (x, y), for every place, (frames, rows, columns).

    What the optics cannot make is left out of the template: it is noise, which the iteration would amplify.
    """
    fy, fx = _frequencies(template.shape)
    spectrum = np.where(np.hypot(fy, fx) <= 2 * np.pi * PASSED / resolution_px, scipy.fft.rfft2(template), 0)
    return scipy.fft.irfft2(spectrum * (1 - _phases(fy, fx, -rest)), template.shape)


def _frequencies(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies of half a spectrum along y and x [rad/px]."""
    rows, columns = shape
    return 2 * np.pi * scipy.fft.fftfreq(rows)[:, None], 2 * np.pi * scipy.fft.rfftfreq(columns)


def _phases(fy: np.ndarray, fx: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Factors of spectra whose images are moved back from places (x, y), (places, rows, columns)."""
    return np.exp(1j * (fx * places[:, 0, None, None] + fy * places[:, 1, None, None]))
