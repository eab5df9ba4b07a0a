"""What was declared of a recording against what its frames show, and the noise that they show.

A contradiction beyond doubt fails the quality check; a doubtful one is worth a warning that says what depends
on it. Of the detector's constants, what a person or a header says stands; a value that is only the profile's
gives way to the frames where these contradict it.

The noise is measured in the frames of the star itself: read noise, excess noise, and the noise of the dark.
The noise of a dark image that is taken from every frame is the same in all frames and does not average
out. A single dark image cannot distinguish it from the detector's own pattern, which is taken out with it
and does no harm; the mean of the frames can: what the dark left there varies from pixel to pixel, faster
than the image of any star, which ends at the cut-off of the telescope, D/λ.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import nan

import numpy as np
import scipy
from scipy.ndimage import median_filter

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import DITTO, Number, key
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import NM, SIGMA_OF_MEDIAN, cutoff_per_px
from irlos_pipe.frames.bad_pixels import Prediction
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import (
    FRAMES,
    PROFILE,
    Detector,
    Recording,
    frame_flux,
    frame_variance,
    mean_frame,
    sample_frames,
)

PREDICTION_ERROR = 0.01  # of the local brightness; a pixel where it dominates the noise is left out
DOMINATES = (0.1, 10.0)  # times the expected variance: of a single frame, and over time
MIN_PIXELS = 100  # pixels times frames that determine the noise, at least
FEWEST = 10  # pixels, at least, for two or three terms
PHOTON_ERROR = 0.02  # relative error of the photon noise that is subtracted from a single frame
ROUNDS = 5
SELECTIONS = 20  # rounds, at most, of choosing the pixels that count
SIGNIFICANT = 5.0  # standard errors
FAINTEST = 5.0  # percentile of the pixels at which noise beyond the declared one shows
FAINT = 0.25  # part of the window
CHI2_MEDIAN = 0.4549  # of one degree of freedom


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise found in the frames, with 1-sigma errors; NaN where it could not be measured."""

    floor_e2: float = float("nan")  # variance per pixel and frame at zero signal above the background [e-²]
    floor_error_e2: float = float("nan")
    excess_noise_factor: float = float("nan")  # slope of variance against signal (1 = Poisson)
    excess_noise_error: float = float("nan")
    # RMS over time of the darkest pixels: what neighbours share, as stripes and a halo, included [e-]
    corner_scatter_e: float = float("nan")

    def beyond_e2(self, known_e2: float) -> float:
        """Return the part of the floor that `known_e2` leaves unexplained; 0 unless significant [e-²]."""
        extra = self.floor_e2 - known_e2
        return float(extra) if extra > SIGNIFICANT * self.floor_error_e2 else 0.0


def measure_noise(
    images_e: np.ndarray, good: np.ndarray, prediction: Prediction, declared: NoiseModel
) -> MeasuredNoise:
    """Fit variance = floor + F·signal + k²·brightness² to the scatter of (pixel - prediction).

    The difference of a pixel from the prediction by its neighbours is blind to speckles and image motion, so
    that the photon-transfer method works on sky; what is left of them, and of an unequal response, grows like
    the brightness and is the third term; where it is not significant, the fit does without it and without the
    pixels that it concerns most. The floor holds the read noise and the photon noise of dark current and sky.
    Of a single frame the difference itself takes the place of its scatter over time, where the star is so
    faint that its own structure does not count; that gives the floor only.

    The `images_e` (frames, rows, columns) are finite [e-], `good` pixels (rows, columns) True; `prediction`
    is that of each pixel by its good neighbours. Only a single frame is compared with the noise as
    `declared`: its star's photon noise is taken out.
    """
    if not len(images_e):
        return MeasuredNoise()
    sample = images_e[sample_frames(len(images_e))]
    if len(sample) == 1:
        return _floor_of_one(sample[0], good, prediction, declared)
    scatter = _Scatter.of(sample, prediction)
    floor, slope = _photon_transfer(scatter, good)
    return MeasuredNoise(*floor, *slope, _corner_scatter_e(sample, good))


@dataclass(frozen=True)
class _Scatter:
    """The variance over time of (pixel - prediction), and what it may consist of; (rows, columns) [e-²]."""

    variance: np.ndarray
    # what a floor of 1 e-², a slope of 1, and an unpredicted part of 1 of the brightness contribute
    flat: np.ndarray
    photons: np.ndarray
    structure: np.ndarray
    frames: int  # independent differences behind each variance
    dependence: float  # see `Prediction.dependence`

    @classmethod
    def of(cls, sample: np.ndarray, prediction: Prediction) -> "_Scatter":
        """Return the scatter of a `sample` (frames, rows, columns)."""
        signal = sample.mean(axis=0, dtype=np.float64)
        variance = (sample - prediction.of(sample)).var(axis=0, ddof=1, dtype=np.float64)
        return cls(variance, *_parts(signal, prediction), len(sample) - 1, prediction.dependence)

    def expected(self, floor: float, slope: float) -> np.ndarray:
        """Return the variance of that floor and slope, (rows, columns) [e-²]."""
        return slope * np.maximum(self.photons, 0) + floor * self.flat

    def fitted(self, chosen: np.ndarray, expected: np.ndarray, count: int) -> list[tuple[float, float]]:
        """Fit the first `count` terms to the `chosen` pixels; see `_fit`."""
        terms = np.stack([self.flat, self.photons, self.structure][:count], axis=-1)[chosen]
        degrees = self.frames / self.dependence
        return _fit(terms, np.zeros(1), self.variance[chosen], expected[chosen], degrees)


def _parts(signal: np.ndarray, prediction: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What floor, photons and structure contribute to the variance of (pixel - prediction)."""
    flat = prediction.variance(np.ones_like(signal))
    return flat, prediction.variance(signal), prediction.local_rms(signal) ** 2


def _photon_transfer(scatter: _Scatter, good: np.ndarray) -> list[tuple[float, float]]:
    """Floor and slope, each with its error; NaN where too few pixels determine them.

    Which pixels count, and for how much, depends on the noise that is sought. It begins with the least that
    can be, from the scatter itself and not from the declared noise: frames in other units then have the same
    noise in other units, and pixels that image motion rules are not taken for noise.
    """
    found = [(float("nan"), float("nan"))] * 2
    seen, slope = _least(scatter, good)
    floor, before = seen, None
    for _ in range(SELECTIONS):
        expected = scatter.expected(max(floor, seen), slope)
        faint, most = (
            good & (PREDICTION_ERROR**2 * scatter.structure < limit * expected) for limit in DOMINATES
        )
        if faint.sum() < FEWEST or faint.sum() * scatter.frames < MIN_PIXELS:
            if before is not None:
                break
            seen, floor, slope = 2 * seen, 2 * floor, 2 * slope
            continue
        if before is not None and all(map(np.array_equal, before, (faint, most))):
            break
        before = faint, most
        *found, (left, left_error) = scatter.fitted(most, expected, 3)
        if not left > SIGNIFICANT * left_error:
            found = scatter.fitted(faint, expected, 2)
        (floor, _), (slope, _) = found
    return found


def _least(scatter: _Scatter, good: np.ndarray) -> tuple[float, float]:
    """The least floor and slope that can be: of the quietest pixels, among all and among the brightest."""
    if not good.any():
        return 0.0, 0.0
    variance, light = scatter.variance[good], scatter.photons[good]
    lit = (light >= np.quantile(light, 1 - FAINT)) & (light > 0)
    slope = float(np.percentile(variance[lit] / light[lit], FAINTEST)) if lit.any() else 0.0
    return float(np.percentile(variance / scatter.flat[good], FAINTEST)), slope


def _floor_of_one(
    image: np.ndarray, good: np.ndarray, prediction: Prediction, declared: NoiseModel
) -> MeasuredNoise:
    """The floor of a single frame, without the declared photon noise."""
    # the pixel's own noise would weigh it
    flat, photons, structure = _parts(np.maximum(prediction.of(image), 0), prediction)
    variance = (image - prediction.of(image)) ** 2
    seen = float(np.percentile(variance[good] / flat[good], FAINTEST)) if good.any() else 0.0
    expected = declared.excess_noise_factor * photons + max(declared.floor_e2, seen) * flat
    faint = good & (PREDICTION_ERROR**2 * structure < DOMINATES[0] * expected)
    if faint.sum() < MIN_PIXELS:
        return MeasuredNoise()
    known, degrees = declared.excess_noise_factor * photons[faint], 1 / prediction.dependence
    ((floor, error),) = _fit(flat[faint, None], known, variance[faint], expected[faint], degrees)
    return MeasuredNoise(floor, float(np.hypot(error, PHOTON_ERROR * np.median(known / flat[faint]))))


def _corner_scatter_e(images_e: np.ndarray, good: np.ndarray) -> float:
    mean_e = np.where(good, images_e.mean(axis=0, dtype=np.float64), np.inf)
    darkest = mean_e <= np.percentile(mean_e[good], FAINTEST)
    return float(np.sqrt(np.median(images_e[:, darkest].var(axis=0, ddof=1, dtype=np.float64))))


def _fit(
    terms: np.ndarray, known: np.ndarray, variance: np.ndarray, expected: np.ndarray, degrees: float
) -> list[tuple[float, float]]:
    """Coefficients of ``variance = known + terms``, each with its error; the first is that of the floor.

    The weights follow the fitted variance, for a variance scatters in proportion to itself. No coefficient is
    negative, but the floor may be while it is fitted: a level of the background that is too low by some
    electrons takes as many off it, which would else be taken off the slope.
    """
    lowest = np.array([-np.inf, 0.0, 0.0])[: terms.shape[1]]
    for _ in range(ROUNDS):
        weighted = terms / expected[:, None]
        unit = np.linalg.norm(weighted, axis=0)  # the terms differ by powers of the unit of the frames
        unit[unit == 0] = 1.0
        solved = scipy.optimize.lsq_linear(
            weighted / unit, (variance - known) / expected, (lowest, np.inf), "bvls"
        )
        solution = solved.x / unit
        expected = np.maximum(known + terms @ solution, 0.05 * expected)
    present = solution > lowest
    inside = (weighted / unit)[:, present]
    errors = np.full(len(solution), np.nan)
    errors[present] = np.sqrt(np.diag(np.linalg.inv(inside.T @ inside)) * 2 / degrees) / unit[present]
    return list(zip(np.maximum(solution, 0.0).tolist(), errors.tolist(), strict=True))


def mean_variance(stack: np.ndarray) -> float:
    """Return the variance per pixel of the mean of a stack (frames, rows, columns) of dark images.

    From a single image it is judged by the differences of neighbouring pixels, an upper bound:
    a true pattern of the detector counts as noise.
    """
    if stack.shape[0] > 1:
        return float(np.median(frame_variance(stack, mean_frame(stack))) / stack.shape[0])
    differences = np.diff(stack[0].astype(np.float64), axis=1)
    scatter = SIGMA_OF_MEDIAN * np.median(np.abs(differences - np.median(differences)))
    return float(scatter**2 / 2)


def dark_variance_e2(
    images_e: np.ndarray, good: np.ndarray, prediction: Prediction | None, at_most_e2: float
) -> float:
    """Measure the variance per pixel of the dark image in the frames that it was taken from [e-²].

    That is the variance over the window of (pixel - prediction), in the mean of `images_e` (frames, rows,
    columns), beyond the scatter between frames. Only `good` pixels count at which the star's own detail, as
    far as the `prediction` leaves it open, is less than that scatter. The result is at most `at_most_e2`: as
    judged from the dark itself, the detector's pattern included, infinite if none was taken. Where the frames
    do not show it, as where there is no `prediction` because detail as fine as a pixel is the star's, it is
    `at_most_e2`, or 0 if that is infinite.
    """
    unknown_e2 = at_most_e2 if np.isfinite(at_most_e2) else 0.0
    if prediction is None or at_most_e2 == 0 or len(images_e) < 2:
        return unknown_e2
    mean_e = mean_frame(images_e)
    by_scatter = prediction.variance(frame_variance(images_e, mean_e) / len(images_e))
    detail = (np.maximum(prediction.error, PREDICTION_ERROR) * prediction.local_rms(mean_e)) ** 2
    seen = good & (detail < DOMINATES[0] * by_scatter)
    if seen.sum() < MIN_PIXELS:
        return unknown_e2
    left, scatter = (mean_e - prediction.of(mean_e))[seen] ** 2, by_scatter[seen]
    gain = prediction.variance(np.ones_like(mean_e))[seen]

    def beyond(dark_e2: float) -> float:
        return float(np.median(left / (scatter + dark_e2 * gain))) - CHI2_MEDIAN

    if beyond(0.0) <= 0:
        return 0.0
    most_e2 = min(at_most_e2, float(np.max(left / gain)) / CHI2_MEDIAN)
    return scipy.optimize.brentq(beyond, 0.0, most_e2) if beyond(most_e2) < 0 else most_e2


Range = tuple[float, float]
ANY = (-math.inf, math.inf)
# The zero point is that of the whole sensor band: a filter, mirrors and detector pass less, never more; the
# colour of the star may make up for 1.2 mag.
FLUX_DOUBTFUL, FLUX_IMPOSSIBLE = (3e-3, 3.0), (1e-5, 30.0)
OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE = (0.0, 1.05), (0.0, 2.0)
CADENCE_DOUBTFUL = (0.9, 1.1)
NOISE_IMPOSSIBLE = (0.25, 4.0)
MOST_EXCESS = (
    2.0  # that multiplication by chance makes (Hynecek & Nishiwaki 2003, IEEE TED 50, 239): more is a gain
)
CUTOFF_DOUBTFUL, CUTOFF_IMPOSSIBLE = (0.7, 1.12), (0.0, 1.25)
SCALE_PLAUSIBLE_MAS = (1.0, 100.0)
SMALLEST_NM = 5.0  # of a diversity or a ramp; anything smaller is probably in micrometres
USELESS_NM = 1.0  # of a diversity, which no sign of a mode can hang on
HIGHEST_NOLL = 37  # of a diversity: a lens or a deformable mirror of low order
OVERFLOWED = "have values 2^16 too low: counts have overflowed an integer"
# The end of the spectrum.
RINGS_PER_PX = 2.0  # rings of the spectrum per sample: half a sample wide
BEYOND = 1.25  # times the expected cut-off, from where there is only noise
LAST_PER_PX = 0.45  # frequency beyond which noise must be left to be seen
ABOVE_NOISE = 3.0  # ring means that count as signal, over those of the noise
LOBE = 2.0  # half of the width of the main lobe of the taper (Hann), in samples of the spectrum
LEAST_SNR = 1e3  # amplitude at zero frequency over noise, below which the end of the spectrum is not seen
# Constants of the detector.
GAIN, READ_NOISE, EXCESS = "detector.e_per_adu", "detector.read_noise_e", "detector.excess_noise_factor"
# Relative error of the slope above which a measured gain is no better than the profile's.
MAX_SLOPE_ERROR = 0.1
NOTABLE = 0.1  # relative difference below which a measurement is neither adopted nor worth a warning


@dataclass(frozen=True)
class Told:
    """One declared value, as a number that the frames or plain sense confine."""

    name: str
    value: float
    doubtful: Range  # outside of it, it is worth a warning,
    impossible: Range  # and outside of this one it is wrong
    text: str  # what the value is, and what depends on it

    @property
    def wrong(self) -> bool:
        return not self.impossible[0] <= self.value <= self.impossible[1]

    @property
    def warned(self) -> bool:
        return self.wrong or not self.doubtful[0] <= self.value <= self.doubtful[1]


def told_of(recording: Recording, noise: MeasuredNoise, facility: Facility, step_s: float) -> list[Told]:
    """Return what was declared of a `recording`, as far as it can be judged.

    `noise` is that of its frames, `step_s` the time from frame to frame by the clock of the recorder, NaN
    where it is not known; the `facility` has pupil and zero point.
    """
    parts = (
        _flux(recording, facility),
        _times(recording, step_s),
        _noise(recording, noise),
        _cutoff(recording, facility),
        _keys(recording),
    )
    return [one for part in parts for one in part if math.isfinite(one.value)]


def _known(recording: Recording, key: str) -> float:
    """A number that a person or the file itself declared; NaN where it is only the profile's."""
    acquisition = recording.acquisition
    value = getattr(acquisition, key)
    told = acquisition.sources.get(key, PROFILE) != PROFILE
    return float(value) if told and value is not None else math.nan


def _flux(recording: Recording, facility: Facility) -> Iterator[Told]:
    mag_j, exposure_s = _known(recording, "mag_j"), _known(recording, "exposure_s")
    expected = facility.photons_per_s_m15 * 10 ** (0.4 * (15 - mag_j)) * exposure_s
    seen = (
        float(np.median(frame_flux(recording.images_e)[recording.used])) if recording.used.any() else math.nan
    )
    text = (
        f"{seen / expected:.2g} times the photons of J = {mag_j:g} in {exposure_s:g} s arrive: gain, "
        "magnitude or exposure; errors and limiting magnitudes hang on them"
    )
    yield Told("flux", seen / expected, FLUX_DOUBTFUL, FLUX_IMPOSSIBLE, text)


def _times(recording: Recording, step_s: float) -> Iterator[Told]:
    exposure_s, rate_hz = _known(recording, "exposure_s"), _known(recording, "frame_rate_hz")
    text = "times the time between frames is exposed: exposure_s or frame_rate_hz; magnitudes hang on it"
    overlap = exposure_s * rate_hz
    yield Told("exposure", overlap, OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE, f"{overlap:.3g} {text}")
    by_clock = exposure_s / step_s
    yield Told(
        "exposure by the clock", by_clock, OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE, f"{by_clock:.3g} {text}"
    )
    cadence = rate_hz * step_s
    told = f"the clock of the recorder has {1 / step_s:.4g} frames per second"
    yield Told(
        "cadence", cadence, CADENCE_DOUBTFUL, ANY, f"{told}, {rate_hz:.4g} are declared: times hang on it"
    )


def _noise(recording: Recording, noise: MeasuredNoise) -> Iterator[Told]:
    """Photon transfer; a difference within its error is none."""
    used = recording.acquisition.detector.excess_noise_factor
    apart = abs(noise.excess_noise_factor - used) > SIGNIFICANT * noise.excess_noise_error
    ratio = noise.excess_noise_factor / used if apart else 1.0
    text = f"photon noise is {ratio:.2g} times what e_per_adu and excess_noise_factor say; errors hang on it"
    yield Told("photon noise", ratio, ANY, NOISE_IMPOSSIBLE, text)


def _cutoff(recording: Recording, facility: Facility) -> Iterator[Told]:
    acquisition = recording.acquisition
    if acquisition.lenslets > 1:
        return
    shortest_m = min(wavelength for wavelength, weight in acquisition.spectrum if weight > 0) * NM
    expected = cutoff_per_px(shortest_m, facility.pupil.diameter_m, acquisition.pixel_scale_mas)
    ratio = cutoff_ratio(recording.mean_e, recording.good, expected)
    text = f"detail ends at {ratio:.2f} times D/λ: pixel scale, wavelength or focus; all modes hang on them"
    yield Told("cut-off", ratio, CUTOFF_DOUBTFUL, CUTOFF_IMPOSSIBLE, text)


def of_counts(adu: np.ndarray) -> Iterator[Told]:
    """Yield what counts, (frames, rows, columns), say of the recorder: integers that have overflowed."""
    count = wrapped_pixels(adu)
    yield Told(
        "overflow", float(count), (0, 0), (0, 0), f"{count} pixels {OVERFLOWED}; all numbers hang on it"
    )


def _keys(recording: Recording) -> Iterator[Told]:
    """Values that no instrument of this kind has."""
    acquisition = recording.acquisition
    scale = acquisition.pixel_scale_mas
    yield Told("pixel scale", scale, SCALE_PLAUSIBLE_MAS, ANY, f"pixel_scale_mas = {scale:g}: unit?")
    for noll, nm in acquisition.diversity.items():
        size, noll_text = abs(nm) or math.inf, f"diversity Noll {noll}"
        text = f"{noll_text} of {nm:g} nm: unit? The sign of the even modes hangs on it"
        yield Told(noll_text, min(size, 1e9), (SMALLEST_NM, math.inf), (USELESS_NM, math.inf), text)
        yield Told(f"{noll_text}, index", float(noll), (2, HIGHEST_NOLL), ANY, f"{noll_text}: unusual mode")
    if acquisition.role == "defocus_ramp":
        largest = float(np.abs(recording.introduced_defocus_nm).max(initial=0.0))
        text = f"introduced defocus (Noll {DEFOCUS}) of {largest:g} nm at most: unit? The slope hangs on it"
        yield Told("introduced defocus", largest or math.nan, (SMALLEST_NM, math.inf), ANY, text)


def cutoff_ratio(
    mean_e: np.ndarray, good: np.ndarray, expected_per_px: float, beyond_per_px: float | None = None
) -> float:
    """Return the highest spatial frequency with signal in `mean_e` over `expected_per_px`, D/λ.

    The noise level is that of the highest frequencies of the image itself, so that hot pixels and an unequal
    response, whose spectrum is flat, do not count as signal; only `good` pixels are looked at. NaN where
    nothing lies beyond the cut-off, or the image is too faint to judge. There is only noise `beyond_per_px`.
    """
    beyond_per_px = beyond_per_px or BEYOND * expected_per_px
    if beyond_per_px > LAST_PER_PX or min(mean_e.shape) < 16:
        return float("nan")
    filled = np.where(good, mean_e, median_filter(mean_e, 5))
    taper = np.outer(*(np.hanning(side + 2)[1:-1] for side in mean_e.shape))
    power = np.abs(np.fft.rfft2(filled * taper)) ** 2
    rows, columns = mean_e.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :])
    width = 1 / (RINGS_PER_PX * max(rows, columns))
    ring = np.round(frequency / width).astype(int)
    count = np.bincount(ring.ravel())
    rings = np.bincount(ring.ravel(), power.ravel()) / np.maximum(count, 1)
    noise = float(np.median(power[(frequency > beyond_per_px) & (frequency < 0.5)])) / np.log(2)
    if not np.sqrt(power[0, 0]) > LEAST_SNR * np.sqrt(noise) > 0:
        return float("nan")
    inside = (count > 0) & (np.arange(len(rings)) * width < 0.5)
    end = float(np.flatnonzero(inside & (rings > ABOVE_NOISE * noise))[-1]) * width
    if end > expected_per_px:  # the taper smears the spectrum by half of its main lobe
        end = max(expected_per_px, end - LOBE / min(mean_e.shape))
    return end / expected_per_px


@dataclass(frozen=True)
class Constant:
    """A constant of the detector, of a frame; the read noise as measured includes that of dark and sky."""

    used: Number = key(nan, "What the reduction goes on with.")
    source: str = key(
        "", "Where that comes from: side-car, recipe, header, instrument profile or ``measured``."
    )
    measured: Number = key(
        nan, "From the frames, the others taken as they are used; NaN where the frames do not tell."
    )
    error: Number = key(nan, DITTO)

    @property
    def contradicted(self) -> bool:
        """Whether the frames disagree, significantly and by more than `NOTABLE`."""
        apart = abs(self.measured - self.used)
        return bool(apart > SIGNIFICANT * self.error and apart > NOTABLE * self.used)


def constants(detector: Detector, sources: Mapping[str, str], noise: MeasuredNoise) -> dict[str, Constant]:
    """Return gain, read noise and excess noise of a `detector` by side-car key, with what frames say of each.

    Frames determine only the ratio of excess noise and gain: each is measured as if the other were right. The
    read noise includes the photon noise of dark current and sky. The `noise` is that of frames converted to
    electrons with this detector; `sources` say where its values come from, by side-car key.
    """
    slope, slope_error = noise.excess_noise_factor, noise.excess_noise_error
    gain = detector.e_per_adu * detector.excess_noise_factor / slope if slope > 0 else np.nan
    read_noise = float(np.sqrt(noise.floor_e2)) if noise.floor_e2 > 0 else np.nan
    measured = {
        GAIN: (detector.e_per_adu, gain, gain * slope_error / slope if slope > 0 else np.nan),
        READ_NOISE: (detector.read_noise_e, read_noise, noise.floor_error_e2 / (2 * read_noise)),
        EXCESS: (detector.excess_noise_factor, slope, slope_error),
    }
    return {
        name: Constant(used, sources.get(name, PROFILE), float(value), float(error))
        for name, (used, value, error) in measured.items()
    }


def believed(
    detector: Detector, sources: Mapping[str, str], noise: MeasuredNoise
) -> tuple[Detector, dict[str, str]]:
    """Return the `detector` with the profile's values replaced where the frames contradict them, and sources.

    An undeclared gain gives way, else an undeclared excess noise does. `sources` and `noise`: see
    `constants`.
    """
    found, new, origin = constants(detector, sources, noise), detector, dict(sources)
    slope = found[EXCESS]
    if slope.contradicted and slope.error < MAX_SLOPE_ERROR * slope.measured:
        if found[GAIN].source == PROFILE:
            new, origin = replace(new, e_per_adu=found[GAIN].measured), origin | {GAIN: FRAMES}
        elif (
            slope.source == PROFILE and 1 - NOTABLE < slope.measured < MOST_EXCESS + SIGNIFICANT * slope.error
        ):
            measured = max(1.0, slope.measured)  # no detector is quieter than the photons
            new, origin = replace(new, excess_noise_factor=measured), origin | {EXCESS: FRAMES}
    if found[READ_NOISE].source == PROFILE and found[READ_NOISE].contradicted:
        in_electrons = found[READ_NOISE].measured * new.e_per_adu / detector.e_per_adu
        new, origin = replace(new, read_noise_e=in_electrons), origin | {READ_NOISE: FRAMES}
    return new, origin


WRAP_ADU = 65536  # range of an integer of 16 bits


def wrapped_pixels(adu: np.ndarray) -> int:
    """Return in how many pixels counts (frames, rows, columns) have passed the end of an integer of 16 bits.

    They begin again at its other end. Optics that are sampled make no image that falls by half of the range
    from one pixel to the next, and a hot pixel is high by itself: three neighbours or more that are higher by
    as much surround a value that has overflowed. A single pixel may be dead, unless it is negative. Counts
    that 16 bits do not hold have not passed their end.
    """
    sample = adu[sample_frames(len(adu))].astype(np.float64)
    most = np.nanmax(sample)
    if min(sample.shape[1:]) < 3 or most >= WRAP_ADU or not most - np.nanmin(sample) > WRAP_ADU / 2:
        return 0
    padded = np.pad(sample, ((0, 0), (1, 1), (1, 1)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    low = (around > sample[..., None, None] + WRAP_ADU / 2).sum(axis=(3, 4)) >= 3
    count = int(low.any(axis=0).sum())
    return count if count > 1 or (sample[low] < -WRAP_ADU / 8).any() else 0
