"""From counts to clean frames in electrons: one pass in the order in which the detector spoils them."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from irlos_pipe.conventions.units import SIGMA_OF_MEDIAN
from irlos_pipe.frames.bad_pixels import (
    Criteria,
    Thresholds,
    deviant_pixels,
    hot_in_dark,
    noisy_pixels,
    seen_variance,
    stuck_pixels,
)
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE, NoiseModel
from irlos_pipe.frames.recording import (
    CalibrationMaps,
    Detector,
    RawFrames,
    mean_frame,
    picked,
    sample_frames,
    star_position,
)
from irlos_pipe.frames.screening import (
    COSMIC,
    NO_HITS,
    ODD,
    SATURATED,
    Hits,
    Limits,
    also,
    clipped_samples,
    core_of,
    cosmic_hits,
    flickering_pixels,
    hit_in_core,
    odd_frames,
    recorder_faults,
    saturated_frames,
    star_faults,
    without_hits,
)
from irlos_pipe.frames.told import MeasuredNoise, dark_variance_e2, measure_noise

LEVEL_SIGMA = 8.0
FRAMES_TO_COMPARE = 3  # frames whose median a single one does not move


@dataclass(frozen=True)
class Background:
    """What is subtracted from the counts; arrays (rows, columns)."""

    adu: np.ndarray  # dark, sky and pedestal together [ADU]
    flat: np.ndarray  # relative response
    bad: np.ndarray  # True for pixels that the calibration images rule out
    # level estimated from the frames; NaN if a dark or background was there [ADU]
    pedestal_adu: float = float("nan")
    pedestal_error_adu: float = float("nan")


@dataclass(frozen=True)
class Cleaned:
    """Clean frames and what was found on the way."""

    images_e: np.ndarray  # (frames, rows, columns), float32, finite everywhere [e-]
    reasons: np.ndarray  # (frames,), why a frame cannot be used; empty if it can
    good: np.ndarray  # (rows, columns)
    background: Background
    hits: Hits  # clipped values and cosmic hits, already replaced in the images
    clipped: np.ndarray  # (rows, columns), True for pixels that are bad because many frames clip them
    noise: MeasuredNoise
    saturation_adu: float | None
    # variance per pixel beyond read noise and star, and of the dark image, see `Recording` [e-²]
    background_variance_e2: float = 0.0
    dark_variance_e2: float = 0.0

    @property
    def used(self) -> np.ndarray:
        """Whether each frame can be used, (frames,)."""
        return self.reasons == ""


def clean(
    raw: RawFrames,
    detector: Detector,
    sampling_px: float,
    thresholds: Thresholds,
    limits: Limits,
    plane: np.ndarray | None = None,
) -> Cleaned:
    """Calibrate a recording, find its bad pixels and cosmic hits, and judge its frames.

    The constants of the `detector` are as declared; `thresholds` and `limits` are those beyond which a pixel
    is bad, and a frame is not used. Undersampled images (2x2 modes), by `sampling_px`, pixels per lambda/D at
    the shortest wavelength, are not searched for hits and deviant pixels, since a star is as sharp as those.
    For the `plane` of every frame see `star_faults`.
    """
    by = Criteria(sampling_px, NoiseModel.of_detector(detector), thresholds)
    reasons = recorder_faults(raw.adu, raw.frame_counter)
    while True:
        cleaned = _cleaned(raw, reasons, detector, by, limits, plane)
        estimated = np.isfinite(cleaned.background.pedestal_adu)
        if not estimated or not cleaned.used.any() or np.array_equal(cleaned.reasons, reasons):
            return cleaned
        reasons = cleaned.reasons  # these frames had a part in the level that all others were judged by
        del cleaned


def _cleaned(
    raw: RawFrames,
    reasons: np.ndarray,
    detector: Detector,
    by: Criteria,
    limits: Limits,
    plane: np.ndarray | None,
) -> Cleaned:
    """The recording by its frames that have no `reasons` against them yet."""
    if not np.any(reasons == ""):
        return _unusable(raw, reasons)
    valid = picked(raw.adu, reasons == "")
    level = saturation_level(valid, detector)
    good = ~_bad_in_counts(valid, raw.calibration.bad, detector, level, by.thresholds.stuck_ratio)
    reasons = also(reasons, saturated_frames(raw.adu, good, level, limits.max_saturated_px), SATURATED)
    background = find_background(valid, raw.calibration, good, raw.lenslets)
    good &= ~background.bad
    if raw.calibration.dark_adu is not None:
        good &= ~hot_in_dark(np.nan_to_num(raw.calibration.dark_adu), detector, by.thresholds)
    images = to_electrons(raw.adu, background.adu, background.flat, detector.e_per_adu)
    np.nan_to_num(images, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    used = np.flatnonzero(reasons == "")
    step_e = detector.e_per_adu if raw.adu.dtype.kind in "iu" else 0.0  # of the digitisation
    clipped = _clipped(images, used, good, by, step_e)
    before = good
    good, images, clipped = _without(images, used, good, by, clipped)
    clipped_often = before & ~good
    if by.well_sampled and len(used):
        sample = by.filled(_sample(images, used), good)
        good = good & ~deviant_pixels(sample, good, by)
        good = good & ~noisy_pixels(sample, good, by)
    images = by.filled(images, good)
    reasons = star_faults(images, reasons, limits, plane)
    used = np.flatnonzero(reasons == "")
    searched = by.well_sampled and len(used) > 1
    hits = cosmic_hits(images, used, good, by) if searched else NO_HITS
    good, images, hits = _without(images, used, good, by, hits)
    hits = clipped.outside(~good).and_those(hits)
    core = core_of(mean_frame(picked(images, reasons == "") if used.size else images), limits)
    reasons = also(reasons, hit_in_core(hits, core, len(images), limits), COSMIC)
    used = np.flatnonzero(reasons == "")
    if by.well_sampled and len(used) >= FRAMES_TO_COMPARE:
        odd = np.zeros(len(images), dtype=bool)
        odd[used] = odd_frames(images, used, good, core, by)
        reasons = also(reasons, odd, ODD)
    used = np.flatnonzero(reasons == "")
    prediction = by.prediction(good) if by.well_sampled else None
    noise = MeasuredNoise()
    if prediction is not None:
        noise = measure_noise(_sample(images, used), good, prediction, by.noise)
    # Without a dark or sky the detector's own pattern is in the frames and counts as noise of a dark.
    taken = raw.calibration.dark_adu is not None or raw.calibration.background_adu is not None
    at_most_e2 = raw.calibration.dark_variance_adu2 * detector.e_per_adu**2 if taken else np.inf
    sky = raw.calibration.background_adu
    sky_e = 0.0 if sky is None else max(0.0, float(np.nanmedian(sky)) * detector.e_per_adu)
    known_e2 = max(sky_e, detector.background_e) * detector.excess_noise_factor
    return Cleaned(
        images_e=images,
        reasons=reasons,
        good=good,
        background=background,
        hits=hits,
        clipped=clipped_often,
        noise=noise,
        saturation_adu=level,
        background_variance_e2=max(noise.beyond_e2(detector.read_noise_e**2), known_e2),
        dark_variance_e2=dark_variance_e2(picked(images, reasons == ""), good, prediction, at_most_e2),
    )


def _sample(images: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Those of the `used` frames that suffice for statistics over time."""
    return images[used[sample_frames(len(used))]]


def _clipped(images: np.ndarray, used: np.ndarray, good: np.ndarray, by: Criteria, step_e: float) -> Hits:
    """Values of the `used` frames that are clipped; the step is that of the digitisation, 0 without one."""
    if not by.well_sampled or len(used) < MIN_FRAMES_FOR_NOISE:
        return NO_HITS
    sample, prediction = _sample(images, used), by.prediction(good)
    mean = sample.mean(axis=0, dtype=np.float64)
    # what the frames show counts as well: the gain may be declared wrong
    seen = seen_variance(sample - prediction.of(sample)) / prediction.variance(np.ones_like(mean))
    sigma = np.sqrt(np.minimum(by.noise.variance_e2(mean), seen))
    searched = images if len(used) == len(images) else images[used]
    frame, row, column = np.nonzero(clipped_samples(searched, good, sigma, step_e))
    return Hits(used[frame], row, column)


def _without(
    images: np.ndarray, used: np.ndarray, good: np.ndarray, by: Criteria, hits: Hits
) -> tuple[np.ndarray, np.ndarray, Hits]:
    """Mask, images and hits after pixels hit too often are bad and other hits are filled in."""
    flicker = flickering_pixels(hits, len(used), good.shape, by.thresholds.flicker_fraction)
    hits, good = hits.outside(flicker), good & ~flicker
    images = by.filled(images, good) if flicker.any() else images
    return good, without_hits(images, hits, good, by), hits


def find_background(
    valid_adu: np.ndarray, maps: CalibrationMaps, good: np.ndarray, lenslets: int = 1
) -> Background:
    """Add up dark and sky of the `maps`, or estimate a pedestal where there is neither.

    `valid_adu` are counts of valid frames (frames, rows, columns); a pedestal is estimated from the `good`
    pixels (rows, columns). `lenslets`: see `RawFrames`.
    """
    window = valid_adu.shape[1:]
    flat, bad = relative_flat(maps.flat, window)
    given = [level for level in (maps.dark_adu, maps.background_adu) if level is not None]
    if given:
        total = np.asarray(np.sum(given, axis=0, dtype=np.float64))
        return Background(np.nan_to_num(total), flat, bad | ~np.isfinite(total))
    mean = mean_frame(_of_one_level(valid_adu, good & ~bad))
    if len(valid_adu) < MIN_FRAMES_FOR_NOISE:  # the darkest pixels would be those of the strongest noise
        mean = median_filter(mean, size=5, mode="nearest")
    level, error = estimate_pedestal(_of_one_star(np.where(good & ~bad, mean, np.nan), lenslets))
    return Background(np.full(window, level), flat, bad, level, error)


def _of_one_level(adu: np.ndarray, good: np.ndarray) -> np.ndarray:
    """The frames without those whose level is apart from the others' by more than noise and its scatter."""
    sample = adu[sample_frames(len(adu))]
    typical = np.median(sample, axis=0)
    noise = SIGMA_OF_MEDIAN * np.median(np.abs(sample - typical)[:, good]) if good.any() else np.inf
    level = np.array([np.median((frame - typical)[good]) if good.any() else 0.0 for frame in adu])
    apart = np.abs(level - np.median(level))
    return picked(adu, apart <= max(noise, LEVEL_SIGMA * SIGMA_OF_MEDIAN * np.median(apart)))


def _of_one_star(image: np.ndarray, lenslets: int) -> np.ndarray:
    """The mean of the images of the lenslets: that of a single star; NaN where all of them are."""
    if lenslets == 1:
        return image
    rows, columns = (size // lenslets for size in image.shape)
    apart = image.reshape(lenslets, rows, lenslets, columns)
    number = np.isfinite(apart).sum(axis=(0, 2))
    return np.where(number > 0, np.nansum(apart, axis=(0, 2)) / np.maximum(number, 1), np.nan)


def _bad_in_counts(
    valid_adu: np.ndarray,
    declared: np.ndarray | None,
    detector: Detector,
    saturation_adu: float | None,
    stuck_ratio: float,
) -> np.ndarray:
    """Pixels declared bad, never finite, or stuck; a saturated star stands still without being stuck."""
    sample = valid_adu[sample_frames(len(valid_adu))]
    bad = ~np.isfinite(sample).all(axis=0)
    sample = np.where(bad, sample.dtype.type(0), sample)
    stuck = stuck_pixels(sample, detector.read_noise_e / detector.e_per_adu, stuck_ratio)
    if saturation_adu is not None:
        level = sample.mean(axis=0, dtype=np.float64)
        stuck &= ~((level >= saturation_adu) & (median_filter(level, size=3) >= saturation_adu / 2))
    return bad | stuck | (False if declared is None else declared)


def _unusable(raw: RawFrames, reasons: np.ndarray) -> Cleaned:
    zeros = np.zeros(raw.window)
    background = Background(zeros, np.ones(raw.window), np.zeros(raw.window, dtype=bool))
    return Cleaned(
        images_e=np.zeros(raw.adu.shape, np.float32),
        reasons=reasons,
        good=np.ones(raw.window, dtype=bool),
        background=background,
        hits=NO_HITS,
        clipped=np.zeros(raw.window, dtype=bool),
        noise=MeasuredNoise(),
        saturation_adu=None,
    )


WING_EXPONENT = 3.0  # the wings of a diffraction image fall like r^-3 on average
WING_START = 0.4  # of the larger window side: beyond it the core no longer matters
DARKEST_PERCENTILE = 1.0
CLIP_BAND = 0.02  # of the range of values: clipped pixels pile up on its very end
CLIP_EXCESS = 5
CLIP_MIN_PIXELS = 3
STANDS_STILL = 0.2  # variance along time over that along a side of the window
CLIP_MIN_LEVELS = 100.0  # ADU between darkest and brightest; fainter images repeat values by chance


def to_electrons(
    adu: np.ndarray, background_adu: np.ndarray, flat: np.ndarray, e_per_adu: float
) -> np.ndarray:
    """Convert counts to electrons above the background: ``(adu - background) / flat * e_per_adu``.

    `adu` (frames, rows, columns) are counts as recorded, `background_adu` (rows, columns) is dark, sky and
    pedestal together, `flat` (rows, columns) the relative response, 1 on average, and `e_per_adu` the gain.
    Returns float32 [e-]; values that are not finite stay so.
    """
    electrons = adu.astype(np.float32)
    electrons -= background_adu.astype(np.float32)
    electrons *= (e_per_adu / flat).astype(np.float32)
    return electrons


def relative_flat(flat: np.ndarray | None, window: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Normalise a `flat` (rows, columns) to a median of 1; None is a response of 1 all over the `window`.

    Returns the flat, 1 where it is unusable, and True where it is not a positive number; (rows, columns)
    each.
    """
    if flat is None:
        return np.ones(window), np.zeros(window, dtype=bool)
    bad = ~(np.isfinite(flat) & (flat > 0))
    if bad.all():
        return np.ones(window), bad
    return np.where(bad, 1.0, flat / np.median(flat[~bad])), bad


def estimate_pedestal(mean_adu: np.ndarray) -> tuple[float, float]:
    """Estimate the level on which a star stands, and its error, from the outer part of its mean image [ADU].

    A robust straight-line fit of ``level + slope * r^-3`` beyond `WING_START` of the window, not above the
    darkest pixels; the error is the difference between the two. The AO halo, flat over a small window, cannot
    be distinguished from a pedestal; the fits let the background of each frame free for that reason. Bad
    pixels of `mean_adu` (rows, columns) are NaN.
    """
    darkest = float(np.nanpercentile(mean_adu, DARKEST_PERCENTILE))
    y0, x0 = star_position(np.nan_to_num(mean_adu, nan=darkest))
    y, x = np.indices(mean_adu.shape)
    radius = np.hypot(y - y0, x - x0)
    outer = (radius > WING_START * max(mean_adu.shape)) & np.isfinite(mean_adu)
    if outer.sum() < 10:
        return darkest, 0.0
    level = _robust_intercept(radius[outer] ** -WING_EXPONENT, mean_adu[outer])
    return min(level, darkest), abs(darkest - level)


def _robust_intercept(x: np.ndarray, y: np.ndarray) -> float:
    """Intercept of a straight line fitted with Cauchy weights."""
    columns = np.stack([np.ones_like(x), x / x.max()], axis=1)
    weights = np.ones_like(y)
    for _ in range(20):
        root = np.sqrt(weights)
        coefficients, *_ = np.linalg.lstsq(columns * root[:, None], y * root, rcond=None)
        residual = y - columns @ coefficients
        scale = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(residual))), 1e-12)
        weights = 1 / (1 + (residual / scale) ** 2)
    return float(coefficients[0])


def saturation_level(adu: np.ndarray, detector: Detector) -> float | None:
    """Return the raw level from which pixels of `adu` (frames, rows, columns) count as saturated [ADU].

    The `detector`'s own level if it is known; else the value on which far more pixels pile up than come close
    to it, or the end of an integer type; None if there is no sign of one.
    """
    if detector.saturation_adu is not None:
        return detector.saturation_adu
    integer = adu.dtype.kind in "iu"
    top, bottom = float(np.nanmax(adu)), float(np.nanmin(adu))
    if top - bottom > CLIP_MIN_LEVELS and _piles_up(adu, top, max(CLIP_BAND * (top - bottom), 5.0)):
        return top
    return float(np.iinfo(adu.dtype).max) if integer else None


def _piles_up(adu: np.ndarray, top: float, band_adu: float) -> bool:
    at_top = adu == top
    below = int(np.sum(adu >= top - band_adu)) - int(at_top.sum())
    # a single pixel that always reads the same is stuck, not saturated
    return at_top.sum() > CLIP_EXCESS * (below + 1) and at_top.any(axis=0).sum() >= CLIP_MIN_PIXELS


def time_is_last(adu: np.ndarray) -> bool:
    """Return whether the last axis of counts, (frames, rows, columns) as declared, is that of the frames.

    Along time a star stands still but for noise and motion, along rows and columns its image ends.
    """
    if min(adu.shape) < 3 or adu.dtype == object:
        return False
    sample = adu[:, :, sample_frames(adu.shape[2])].astype(np.float64)
    return bool(sample.var(axis=2).mean() < STANDS_STILL * sample.var(axis=0).mean())
