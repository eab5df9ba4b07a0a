"""A scene: star, telescope, sky, aberrations, effects and detector of one recording."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import key
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.pupil_drawing import PupilGeometry, turned
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.mirror import Mirror
from irlos_pipe.simulate.motion import Motion

STATIC_PUPIL_SAMPLES, MOVING_PUPIL_SAMPLES = 256, 128
LENSLET_WINDOW = (36, 36)  # of the four images of a 2x2 mode, 18 px across each
LENSLET_SAMPLING = 2  # over the fewest samples possible, for windows as wide as those of lenslets
RANDOM_STREAMS = ("sky", "motion", "effects", "focus_stage")


@dataclass(frozen=True)
class Sampling:
    """Fineness of the computation, for tests and for checks of the accuracy; the tests budget each default.

    Without `pupil_samples`: `STATIC_PUPIL_SAMPLES`, or `MOVING_PUPIL_SAMPLES` with a sky. Screens of the AO
    residual 0.01 s apart make the mean residual of a frame scatter by 5 % more than continuous exposure.
    """

    pupil_samples: int | None = key(None, "across the diameter", ge=32, le=1024)
    points_per_band: int = key(4, "wavelengths per band", ge=1, le=41)
    step_s: float = key(0.01, "longest time between instantaneous images", ge=1e-4, le=10)


@dataclass(frozen=True)
class Scene:
    """One recording.

    Aberrations are by Noll index [nm RMS]. What the side-car does not state are the errors of the lenslets,
    of the mirror and of the aberrations, and `effects` by their catalogue names, with the catalogue's
    parameters.
    """

    name: str
    facility: Facility
    bands: tuple[Band, ...]
    seed: tuple[int, ...]  # of everything random in this recording
    frames: int
    exposure_s: float
    role: str = "ncpa_calibration"
    target: str = "simulated"
    mag_j: float = 7.0
    throughput: float = 1.0  # part of the facility's photons that the bands pass
    frame_rate_hz: float = 10.0
    window: tuple[int, int] = (64, 64)  # rows and columns; with lenslets, of their four images side by side
    lenslets: int = 1  # per side of the pupil: 1, or 2
    # displacement (x, y) of the image of each: lower left, lower right, upper left, upper right
    lenslet_tilts_mas: tuple[tuple[float, float], ...] = ((0.0, 0.0),) * 4
    lenslet_flux: tuple[float, ...] = (0.0,) * 4  # light of each beyond its share, relative
    pixel_scale_mas: float = 9.7
    ncpa_nm: Mapping[int, float] = field(default_factory=dict)
    # in addition, what lies before the derotator, as it is at angle 0; it turns anticlockwise with the angle
    rotating_nm: Mapping[int, float] = field(default_factory=dict)
    derotator_angle_deg: float = 0.0
    pupil_rotation_deg: float = 0.0  # of the facility's pupil on the detector, anticlockwise
    diversity_nm: Mapping[int, float] = field(default_factory=dict)
    diversity_source: str = "lens"
    introduced_nm: float | tuple[float, ...] = 0.0  # defocus (Noll 4) of all frames, or of every frame
    mirror: Mirror | None = None  # with the offsets it has been sent; what it makes of them is truth
    sky: Sky | None = None  # AO residual; None on the bench
    motion: Motion | None = None  # residual tip-tilt
    sky_e_per_s: float = 0.0  # light of the sky in every pixel
    effects: Mapping[str, Mapping] = field(default_factory=dict)
    detector: DetectorModel = field(default_factory=DetectorModel)
    sampling: Sampling = field(default_factory=Sampling)
    start_unix_s: int = 1_707_618_000
    first_counter: int = 1000

    def __post_init__(self) -> None:
        for problem in filter(None, (effect.misfit(self) for effect in self.acting("misfit"))):
            raise SceneError(problem)
        given = self.frames if isinstance(self.introduced_nm, float | int) else len(self.introduced_nm)
        if given != self.frames:
            raise SceneError(f"introduced_nm: {given} values for {self.frames} frames; give one or as many")
        try:
            self.detector.reads(self.exposure_s)
        except ConfigurationError as problem:
            raise SceneError(f"detector.read_s: {problem}") from None

    @property
    def geometry(self) -> PupilGeometry:
        """The pupil as it lies on the detector."""
        return turned(self.facility.pupil, self.pupil_rotation_deg)

    def acting(self, method: str) -> list[Any]:
        """Return the effects that have a `method`, see `effects.base`, in the order in which they act."""
        return [effect for effect in effects_of(self.effects) if hasattr(effect, method)]

    @property
    def residual_wfe_nm(self) -> float:
        """Total AO residual [nm RMS]; 0 on the bench."""
        return self.sky.total_nm(self.facility.residual_law) if self.sky else 0.0

    @property
    def photons(self) -> float:
        """Return the photons per frame through the whole aperture."""
        rate = self.facility.photons_per_s_m15 * 10 ** (0.4 * (15 - self.mag_j)) * self.throughput
        return rate * self.exposure_s

    @property
    def reads(self) -> int:
        return self.detector.reads(self.exposure_s)

    @property
    def moves(self) -> bool:
        """Return whether the wavefront changes during a frame, image motion apart."""
        return self.sky is not None

    @property
    def pupil_samples(self) -> int:
        usual = MOVING_PUPIL_SAMPLES if self.moves else STATIC_PUPIL_SAMPLES
        return self.sampling.pupil_samples or (
            usual if self.lenslets == 1 else max(usual, LENSLET_SAMPLING * self.needed_samples)
        )

    @property
    def needed_samples(self) -> int:
        """Fewest samples across the pupil for which no image repeats itself in its window."""
        shortest_m = min(nm for nm, _ in self.spectrum()) * NM
        element_px = resolution_px(shortest_m, self.geometry.diameter_m, self.pixel_scale_mas)
        return math.ceil(max(self.window) // self.lenslets / element_px)

    @property
    def subexposures(self) -> int:
        """Return the number of instantaneous images per frame."""
        return math.ceil(self.exposure_s / self.sampling.step_s - 1e-9) if self.moves else 1

    @property
    def period_s(self) -> float:
        """Return the time from the start of one frame to the next [s]."""
        return max(1 / self.frame_rate_hz, self.exposure_s)

    def rng(self, stream: str) -> np.random.Generator:
        """Return the generator of the `stream`, one of `RANDOM_STREAMS`, independent of the others."""
        key = RANDOM_STREAMS.index(stream)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(key,)))

    @property
    def introduced_per_frame_nm(self) -> np.ndarray:
        """Return the introduced defocus, (frames,) [nm RMS]."""
        return np.broadcast_to(np.asarray(self.introduced_nm, float), (self.frames,))

    def spectrum(self, points_per_band: int | None = None) -> list[tuple[float, float]]:
        """Return (wavelength [nm], photon weight) of a Gauss–Legendre rule with `points_per_band`."""
        nodes, weights = np.polynomial.legendre.leggauss(points_per_band or self.sampling.points_per_band)
        return [
            (float(band.centre_nm + band.half_width_nm * node), float(weight / 2 * band.share))
            for band in self.bands
            for node, weight in zip(nodes, weights, strict=True)
        ]


def draw_ncpa_nm(
    rng: np.random.Generator, law: NcpaLaw, total_nm: float, modes: int = 50
) -> dict[int, float]:
    """Draw static aberrations of a number of `modes` from Noll 2 on, Noll: nm RMS.

    The `law` gives the standard deviations before scaling, tip and tilt sharing that of Noll 2; every draw
    from `rng` is scaled to `total_nm`, the root of the sum of squares.
    """
    nolls = np.arange(2, modes + 2)
    nolls[1:2] = 2
    drawn_nm = law.sigma_nm(nolls) * rng.standard_normal(modes)
    return dict(enumerate((drawn_nm * total_nm / np.linalg.norm(drawn_nm)).tolist(), start=2))


def draw_tail_nm(
    rng: np.random.Generator, rms_nm: float, first_noll: int, last_noll: int
) -> dict[int, float]:
    """Draw modes `first_noll` to `last_noll` of a standard deviation `rms_nm` from `rng`, Noll: nm RMS.

    They are as fine as the polish of the optics leaves them.
    """
    values_nm = rms_nm * rng.standard_normal(last_noll + 1 - first_noll)
    return dict(enumerate(values_nm.tolist(), start=first_noll))
