"""What was declared of a recording against what its frames show.

A contradiction beyond doubt fails the quality check; a doubtful one is worth a warning that says what depends
on it. Of the detector's constants, what a person or a header says stands; a value that is only the profile's
gives way to the frames where these contradict it.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import nan

import numpy as np
from scipy.ndimage import median_filter

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import DITTO, Number, key
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import NM, cutoff_per_px
from irlos_pipe.frames.cleaning import wrapped_pixels
from irlos_pipe.frames.measured_noise import SIGNIFICANT, MeasuredNoise
from irlos_pipe.frames.recording import FRAMES, PROFILE, Detector, Recording, frame_flux

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
