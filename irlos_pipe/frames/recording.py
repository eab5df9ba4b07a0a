"""A recording as arrays: frames as a recorder left them, and after cleaning, with what is known about them.

`Recording` is the only form in which images reach the science code: ingest makes it from files.

Frames are worked on in blocks: what is computed on the way does not grow with their number. Sums over frames
are taken in float64 block by block; with more than `BLOCK_FRAMES` frames they may differ from a sum in one go
by its rounding.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

# Sources of values.
RECIPE, SIDECAR, HEADER, PROFILE, FRAMES = "recipe", "side-car", "header", "instrument profile", "measured"
MODE = "read-out mode by the instrument profile"
PER_FRAME = ("images_e", "used", "reason", "time_s", "frame_counter", "introduced_defocus_nm")


@dataclass(frozen=True)
class CalibrationMaps:
    """Calibration images that came with a recording, each (rows, columns) or None."""

    dark_adu: np.ndarray | None = None  # signal without light [ADU]
    dark_variance_adu2: float = 0.0  # variance per pixel of `dark_adu` itself [ADU²]
    background_adu: np.ndarray | None = None  # sky on top of the dark [ADU]
    flat: np.ndarray | None = None  # response of each pixel; only its ratio to the median matters
    bad: np.ndarray | None = None  # True for pixels declared dead or without weight


@dataclass(frozen=True, kw_only=True)
class RawFrames:
    """Counts of one recording, and the calibration images that came with it."""

    adu: np.ndarray  # (frames, rows, columns), in the type they were recorded in
    frame_counter: np.ndarray  # (frames,), counter of the recorder, whole numbers
    calibration: CalibrationMaps = CalibrationMaps()
    lenslets: int = 1  # per side of the pupil; with 2 the window is that of four images side by side

    @property
    def frames(self) -> int:
        return self.adu.shape[0]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns [px]."""
        _, rows, columns = self.adu.shape
        return rows, columns


@dataclass(frozen=True)
class Detector:
    """Detector constants."""

    e_per_adu: float  # conversion gain [e-/ADU]
    read_noise_e: float  # per pixel and frame, RMS [e-]
    excess_noise_factor: float = 1.0  # variance of the photon signal over its Poisson variance
    saturation_adu: float | None = None  # raw level from which a pixel counts as saturated [ADU]
    reads: int = 1  # that a frame is the sum of; `read_noise_e` is that of all together
    background_e: float = 0.0  # light of the sky and dark current in a pixel of a frame, as declared [e-]

    def accumulated(self, frames: int) -> "Detector":
        """Return the constants of a sum of so many `frames`."""
        saturation = None if self.saturation_adu is None else frames * self.saturation_adu
        return replace(
            self,
            read_noise_e=self.read_noise_e * frames**0.5,
            saturation_adu=saturation,
            reads=frames * self.reads,
            background_e=frames * self.background_e,
        )


@dataclass(frozen=True)
class Acquisition:
    """How a recording was taken: the keys of the side-car, which `readers.sidecar` explains, as settled."""

    role: str
    detector: Detector
    spectrum: tuple[tuple[float, float], ...]  # wavelengths [nm] with photon weights, any positive scale
    diversity: dict[int, float]  # introduced, Noll index to nm RMS
    pixel_scale_mas: float
    diversity_source: str = "lens"
    target: str = ""
    mag_j: float | None = None
    exposure_s: float | None = None
    frame_rate_hz: float | None = None
    seeing_arcsec: float | None = None
    derotator_angle_deg: float = 0.0
    parallactic_angle_deg: float | None = None
    altitude_deg: float | None = None
    zenith_angle_deg: float | None = None  # direction of the zenith in the image, from +x towards +y
    pressure_hpa: float | None = None
    temperature_c: float | None = None
    humidity_percent: float | None = None
    dispersion_corrected: bool = False
    filter: str = ""  # its name; empty if not known
    pupil_rotation_deg: float = 0.0  # from how the instrument profile draws the pupil, anticlockwise
    mode: str = ""  # read-out mode string of the sensor; empty if the layout has none
    lenslets: int = 1  # per side of the pupil; with 2 a frame is four images side by side
    sources: dict[str, str] = field(default_factory=dict)  # for every key, where its value came from

    @property
    def wavelength_nm(self) -> float:
        """Mean wavelength of the photons [nm]."""
        wavelengths_nm, weights = np.array(self.spectrum, float).T
        return float(np.average(wavelengths_nm, weights=weights))

    @property
    def seeing_measured(self) -> bool:
        """Whether the seeing is that of the recording, and not a typical one."""
        return self.seeing_arcsec is not None and self.sources.get("seeing_arcsec") != PROFILE


@dataclass(frozen=True)
class Recording:
    """Cleaned frames of one recording."""

    name: str  # folder or file stem
    input: str  # of the recipe, for example ``calibration`` or ``ramp``
    # (frames, rows, columns), float32: signal above background [e-]; bad pixels hold finite values
    images_e: np.ndarray
    used: np.ndarray  # (frames,), False for rejected frames
    reason: np.ndarray  # (frames,), why a frame was rejected; empty for used frames
    good: np.ndarray  # (rows, columns), False for bad pixels
    time_s: np.ndarray  # (frames,), since the first frame
    frame_counter: np.ndarray  # (frames,), of the recorder
    introduced_defocus_nm: np.ndarray  # (frames,) [nm RMS]
    acquisition: Acquisition
    # variance per pixel beyond read noise and source photons, e.g. of the background, and of the dark image
    # that was taken from every frame [e-²]
    background_variance_e2: float = 0.0
    dark_variance_e2: float = 0.0
    frames_missing: int = 0  # frames the recorder lost (gaps of the counter)
    start_unix_s: float = float("nan")  # time of the first frame since 1970; NaN if not known

    @property
    def frames(self) -> int:
        """Number of frames, rejected ones included."""
        return self.images_e.shape[0]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns of the window [px]."""
        _, rows, columns = self.images_e.shape
        return rows, columns

    @cached_property
    def mean_e(self) -> np.ndarray:
        """Mean of the used frames (rows, columns) [e-]; zeros where none is used."""
        return mean_frame(picked(self.images_e, self.used)) if self.used.any() else np.zeros(self.window)

    def accepted(self) -> "Recording":
        """Return the recording with the used frames only."""
        return self.of(self.used)

    def of(self, which: np.ndarray) -> "Recording":
        """Return the recording with some of its frames, True in `which` (frames,), only."""
        kept: dict[str, Any] = {name: picked(getattr(self, name), which) for name in PER_FRAME}
        return replace(self, **kept)

    def planes(self) -> "list[Recording]":
        """Return the frames of each introduced defocus by themselves, the smallest defocus first."""
        introduced_nm = np.unique(self.introduced_defocus_nm)
        if len(introduced_nm) < 2:
            return [self]
        nearest = sorted(introduced_nm, key=lambda nm: (abs(nm), nm))
        return [self.of(self.introduced_defocus_nm == nm) for nm in nearest]


BLOCK_FRAMES = 256  # 8 MiB of float64 in a window of 64x64
SAMPLE_FRAMES = 200  # frames that suffice for statistics over time


def blocks(frames: int) -> Iterator[slice]:
    """Yield consecutive slices of at most `BLOCK_FRAMES` frames."""
    return (slice(start, start + BLOCK_FRAMES) for start in range(0, frames, BLOCK_FRAMES))


def sample_frames(frames: int, at_most: int = SAMPLE_FRAMES) -> np.ndarray:
    """Return indices of evenly spread ones of so many `frames`, `at_most` of them."""
    return np.unique(np.linspace(0, frames - 1, min(frames, at_most)).astype(int))


def picked(frames: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Return those of the `frames` that a mask says to `keep`, without a copy where all are kept."""
    return frames if keep.all() else frames[keep]


def mean_frame(images: np.ndarray) -> np.ndarray:
    """Return the mean of images (frames, rows, columns), float64."""
    total = sum(images[block].sum(axis=0, dtype=np.float64) for block in blocks(len(images)))
    return total / len(images)


def frame_variance(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the sample variance of two `images` or more (frames, rows, columns) about their `mean`."""
    with np.errstate(invalid="ignore"):  # of an infinite pixel: it is NaN
        squares = sum(np.square(images[block] - mean).sum(axis=0) for block in blocks(len(images)))
    return squares / (len(images) - 1)


def frame_flux(images_e: np.ndarray) -> np.ndarray:
    """Return the signal of each image (frames, rows, columns), summed over the window [e-]."""
    return images_e.sum(axis=(1, 2), dtype=np.float64)


HALF, CORE = 0.5, 0.1  # of the peak: from where the width counts, and the centroid
SERIES = {  # what every frame shows of the star, without a model: for plots against time
    "flux_e": ("e-", "frame", "sum of a frame over the window"),
    "peak_e": ("e-", "frame", "brightest good pixel of a frame above its level"),
    "level_e": ("e-", "frame", "median of the rim of the window, one pixel wide"),
    "fwhm_px": ("px", "frame", "diameter of the circle of the area above half the peak"),
    "x_px": ("px", "frame", "centroid of what stands above a tenth of the peak, from the window's centre"),
    "y_px": ("px", "frame", "centroid of what stands above a tenth of the peak, from the window's centre"),
}


def frame_series(images_e: np.ndarray, good: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers of `SERIES` for images (frames, rows, columns); only `good` pixels count."""
    found = [_series(images_e[block], good) for block in blocks(len(images_e))]
    return {"flux_e": frame_flux(images_e)} | {
        name: np.concatenate([one[name] for one in found]) for name in found[0]
    }


def _series(images_e: np.ndarray, good: np.ndarray) -> dict[str, np.ndarray]:
    rim = np.ones(good.shape, bool)
    rim[1:-1, 1:-1] = False
    level = np.median(images_e[:, rim & good if (rim & good).any() else rim], axis=1)
    above = np.where(good, images_e - level[:, None, None], 0.0)
    peak = above.max(axis=(1, 2))
    half = HALF * peak[:, None, None]
    # The part of a pixel above half the peak: its value falls across it by the gradient.
    fall = sum(np.abs(np.gradient(above, axis=axis)) for axis in (1, 2) if above.shape[axis] > 1)
    area = np.clip(0.5 + (above - half) / np.maximum(fall, 1e-9), 0, 1).sum(axis=(1, 2))
    weight = np.where(above > CORE * peak[:, None, None], above, 0.0)
    total = np.maximum(weight.sum(axis=(1, 2)), 1e-9)
    y, x = (np.arange(size) - (size - 1) / 2 for size in good.shape)
    return {
        "peak_e": peak,
        "level_e": level,
        "fwhm_px": 2 * np.sqrt(area / np.pi),
        "x_px": weight.sum(axis=1) @ x / total,
        "y_px": weight.sum(axis=2) @ y / total,
    }


def star_position(image: np.ndarray) -> tuple[float, float]:
    """Return the centroid (row, column) of what stands above a tenth of the peak [px]."""
    above = image - np.median(image)
    weights = np.where(above > 0.1 * above.max(), above, 0.0)
    total = weights.sum()
    if total <= 0:
        return (image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2
    y, x = np.indices(image.shape)
    return float((weights * y).sum() / total), float((weights * x).sum() / total)
