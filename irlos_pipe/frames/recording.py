"""A recording as arrays: frames as a recorder left them, and after cleaning, with what is known about them.

`Recording` is the only form in which images reach the science code: ingest makes it from files.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from irlos_pipe.frames.blocks import mean_frame, picked

# Sources of values.
RECIPE, SIDECAR, HEADER, PROFILE, FRAMES = "recipe", "side-car", "header", "instrument profile", "measured"
MODE = "read-out mode by the instrument profile"
PER_FRAME = ("images_e", "used", "reason", "time_s", "frame_counter", "introduced_defocus_nm")


@dataclass(frozen=True)
class CalibrationMaps:
    """Calibration images that came with a recording, each (rows, columns) or None.

    Attributes
    ----------
    dark_adu : ndarray
        Signal without light [ADU].
    dark_variance_adu2 : float
        Variance per pixel of `dark_adu` itself [ADU²].
    background_adu : ndarray
        Sky on top of the dark [ADU].
    flat : ndarray
        Response of each pixel; only its ratio to the median matters.
    bad : ndarray of bool
        True for pixels declared dead or without weight.
    """

    dark_adu: np.ndarray | None = None
    dark_variance_adu2: float = 0.0
    background_adu: np.ndarray | None = None
    flat: np.ndarray | None = None
    bad: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class RawFrames:
    """Counts of one recording, and the calibration images that came with it.

    Attributes
    ----------
    adu : ndarray, (frames, rows, columns)
        Counts in the type they were recorded in.
    frame_counter : ndarray of int, (frames,)
        Counter of the recorder.
    lenslets : int
        Per side of the pupil; with 2 the window is that of four images side by side.
    """

    adu: np.ndarray
    frame_counter: np.ndarray
    calibration: CalibrationMaps = CalibrationMaps()
    lenslets: int = 1

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
    """Detector constants.

    Attributes
    ----------
    e_per_adu : float
        Conversion gain [e-/ADU].
    read_noise_e : float
        Read noise per pixel and frame, RMS [e-].
    excess_noise_factor : float
        Variance of the photon signal over its Poisson variance (1 = Poisson).
    saturation_adu : float or None
        Raw level from which a pixel counts as saturated [ADU].
    reads : int
        That a frame is the sum of; `read_noise_e` is that of all together.
    background_e : float
        Light of the sky and dark current in a pixel of a frame, as declared [e-].
    """

    e_per_adu: float
    read_noise_e: float
    excess_noise_factor: float = 1.0
    saturation_adu: float | None = None
    reads: int = 1
    background_e: float = 0.0

    def accumulated(self, frames: int) -> Detector:
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
    """How a recording was taken (side-car ``acquisition.yaml``, recipe, or instrument defaults).

    Attributes
    ----------
    spectrum : tuple of (wavelength_nm, weight)
        Photon weights, any positive scale.
    diversity : dict of int to float
        Introduced diversity, Noll index to nm RMS.
    mode : str
        Read-out mode string of the sensor; empty if the layout has none.
    lenslets : int
        Per side of the pupil: 1 for the full pupil; with 2 a frame is four images side by side.
    parallactic_angle_deg, altitude_deg : float or None
        Angles of the telescope.
    zenith_angle_deg : float or None
        Direction of the zenith in the image, from +x towards +y.
    pressure_hpa, temperature_c, humidity_percent : float or None
        Air at the telescope.
    dispersion_corrected : bool
        Whether a corrector takes out the dispersion of the atmosphere.
    filter : str
        Name of the filter; empty if not known.
    pupil_rotation_deg : float
        By which the pupil is turned on the detector from how the instrument profile draws it, anticlockwise.
    sources : dict of str to str
        For every key, where its value came from.
    """

    role: str
    detector: Detector
    spectrum: tuple[tuple[float, float], ...]
    diversity: dict[int, float]
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
    zenith_angle_deg: float | None = None
    pressure_hpa: float | None = None
    temperature_c: float | None = None
    humidity_percent: float | None = None
    dispersion_corrected: bool = False
    filter: str = ""
    pupil_rotation_deg: float = 0.0
    mode: str = ""
    lenslets: int = 1
    sources: dict[str, str] = field(default_factory=dict)

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
    """Cleaned frames of one recording.

    Attributes
    ----------
    name : str
        Name of the recording (folder or file stem).
    input : str
        Recipe input it belongs to, for example ``calibration`` or ``ramp``.
    images_e : ndarray, (frames, rows, columns), float32
        Signal above background [e-]; bad pixels hold finite values and are masked.
    used : ndarray of bool, (frames,)
        False for rejected frames.
    reason : ndarray of str, (frames,)
        Why a frame was rejected; empty for used frames.
    good : ndarray of bool, (rows, columns)
    time_s, frame_counter, introduced_defocus_nm : ndarray, (frames,)
        Time since the first frame, counter of the recorder, introduced defocus [nm RMS].
    background_variance_e2 : float
        Variance per pixel beyond read noise and source photons, e.g. of the background [e-²].
    dark_variance_e2 : float
        Variance per pixel of the dark image that was taken from every frame [e-²].
    frames_missing : int
        Frames the recorder lost (gaps of the counter).
    start_unix_s : float
        Time of the first frame since 1970 [s]; NaN if not known.
    """

    name: str
    input: str
    images_e: np.ndarray
    used: np.ndarray
    reason: np.ndarray
    good: np.ndarray
    time_s: np.ndarray
    frame_counter: np.ndarray
    introduced_defocus_nm: np.ndarray
    acquisition: Acquisition
    background_variance_e2: float = 0.0
    dark_variance_e2: float = 0.0
    frames_missing: int = 0
    start_unix_s: float = float("nan")

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

    def accepted(self) -> Recording:
        """Return the recording with the used frames only."""
        return self.of(self.used)

    def of(self, which: np.ndarray) -> Recording:
        """Return the recording with some of its frames, True in `which` (frames,), only."""
        kept: dict[str, Any] = {name: picked(getattr(self, name), which) for name in PER_FRAME}
        return replace(self, **kept)

    def planes(self) -> list[Recording]:
        """Return the frames of each introduced defocus by themselves, the smallest defocus first."""
        introduced_nm = np.unique(self.introduced_defocus_nm)
        if len(introduced_nm) < 2:
            return [self]
        nearest = sorted(introduced_nm, key=lambda nm: (abs(nm), nm))
        return [self.of(self.introduced_defocus_nm == nm) for nm in nearest]
