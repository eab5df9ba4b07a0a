"""Focus loops closed side by side on the same sky and drift: what they see, and with which sensor."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev

from irlos_pipe.control.linear_theory import Drift
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.lenslets import modes_of_centroids_nm
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.ramp_fit import ramp_effects
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common import observation
from irlos_pipe.paper.common.ramps import TTF, Knowledge
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

FOCUS = TTF.index(DEFOCUS)
# A loop discards a measurement so uncertain, or so far from where a closed loop can be. Near
# the faint limit LIFT ends now and then in a noise peak, far away and with a small formal error.
LARGEST_SIGMA_NM, FARTHEST_NM = 100.0, 200.0
CENTROIDS, LIFT = "centroids_2x2", "lift_2x2"
TWO_BY_TWO = (CENTROIDS, LIFT)
MIN_FOR_A_SLOPE = 20  # measurements; of fewer the slope would be mostly noise
DRAWS = 400  # images; the standard deviation of so many is known to 4 %
WEIGHTS = NoiseModel(1.0, 1.0)  # by which pixels count in an image that has no noise


# -- frames at any defocus ---------------------------------------------------------------------------


@dataclass(frozen=True)
class FrameTable:
    """Noise-free frames of one scene as a function of the defocus that a loop leaves, within `reach_nm`.

    In a closed loop every star, configuration and gain sees another defocus, but the same sky. So every
    frame is simulated at a few defoci, and its pixels interpolated between them by a Chebyshev series. An
    image depends on defocus through ``exp(2πi a ΔZ₄/λ)``, the differences ΔZ₄ below 3.4 over this pupil: it
    is band-limited in a, and the series converges as fast as Bessel functions do beyond their argument.
    """

    reach_nm: float
    # Chebyshev coefficients of the mean electrons per pixel, (orders, frames, rows, columns)
    series_e: np.ndarray
    sky_focus_nm: np.ndarray  # of the AO residual itself, the mean over each frame, (frames,)

    def images_e(self, frame: int, defocus_nm: np.ndarray) -> np.ndarray:
        """Return the mean electrons of `frame` at every one of `defocus_nm`, (defoci, rows, columns)."""
        orders, _, *window = self.series_e.shape
        weights = chebyshev.chebvander(np.asarray(defocus_nm) / self.reach_nm, orders - 1)
        flat = self.series_e[:, frame].reshape(orders, -1)
        return (weights @ flat).reshape(-1, *window)


def frame_table(scene: Scene, reach_nm: float, nodes: int) -> FrameTable:
    """Simulate `scene` at the `nodes` Chebyshev nodes of ±`reach_nm`; the sky is the same at all of them."""
    points = chebyshev.chebpts1(nodes)
    exposed = [expose(replace(scene, introduced_nm=float(point * reach_nm))) for point in points]
    to_series = np.linalg.inv(chebyshev.chebvander(points, nodes - 1))
    series = np.tensordot(to_series, np.stack([one.mean_e for one in exposed]), axes=1).astype(np.float32)
    focus = exposed[0].zernike_nm[:, DEFOCUS - 2] - scene.ncpa_nm.get(DEFOCUS, 0.0)
    return FrameTable(reach_nm, series, focus)


# -- sensors -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FocusSensor:
    """LIFT with tip, tilt and defocus free, started from zero: the loops hold the image there.

    `model` has AO residual and jitter; `zero_nm` is what it measures where there is no defocus, if known.
    Bound and noise are those of an image with `seen_e` electrons in the window, at zero defocus [nm RMS].
    """

    model: ImageModel
    zero_nm: float = 0.0

    def measure(self, images_e: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return the defocus of every image, (images,) [nm RMS]; NaN where none is to be used."""
        images = torch.as_tensor(images_e)
        good = torch.ones(images.shape[1:], dtype=torch.bool)
        start = torch.zeros(len(images), len(TTF), dtype=torch.float64)
        result = lift(self.model, images, good, noise, start, LiftOptions("model"))
        defocus, sigma = result.mode(DEFOCUS)
        credible = (sigma < LARGEST_SIGMA_NM) & (defocus.abs() < FARTHEST_NM)
        measured = torch.where(result.solution.converged & credible, defocus, torch.nan)
        return measured.numpy() - self.zero_nm

    def bound_nm(self, seen_e: float, noise: NoiseModel) -> float:
        zero = torch.zeros(1, len(TTF), dtype=torch.float64)
        in_window = self.model.psf.images(zero, self.model.optics).double().sum().cpu()
        return float(cramer_rao_nm(self.model, zero, seen_e / in_window[None], noise)[0, FOCUS])

    def photon_noise_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """Return the noise of a measurement without an AO residual: the bound, which LIFT reaches."""
        return self.bound_nm(seen_e, noise)


@dataclass(frozen=True)
class CentroidSensor(FocusSensor):
    """Centres of light of four images above a threshold: the classical 2x2 Shack–Hartmann sensor.

    `scene` is in the 2x2 mode; `model`, that of the same images, gives the bound of any estimate from them.
    """

    scene: Scene = field(kw_only=True)

    def measure(self, images_e: np.ndarray, noise: NoiseModel) -> np.ndarray:
        geometry, scale_mas = self.scene.geometry, self.scene.pixel_scale_mas
        modes_nm = modes_of_centroids_nm(images_e, geometry, scale_mas, float(np.sqrt(noise.floor_e2)), TTF)
        defocus_nm = modes_nm[:, FOCUS] - self.zero_nm
        return np.where(np.abs(defocus_nm) < FARTHEST_NM, defocus_nm, np.nan)

    def photon_noise_nm(self, seen_e: float, noise: NoiseModel) -> float:
        """Return the scatter of drawn images, which is above the bound."""
        zero = torch.zeros(1, len(TTF), dtype=torch.float64)
        mean_e = self.model.psf.images(zero, self.model.optics).double().cpu().numpy()
        mean_e *= seen_e / mean_e.sum()
        scatter_e = np.sqrt(noise.excess_noise_factor * mean_e + noise.floor_e2)
        drawn_e = mean_e + scatter_e * np.random.default_rng(0).standard_normal((DRAWS, *mean_e.shape[1:]))
        return float(np.nanstd(self.measure(drawn_e, noise)))


def focus_sensor(scene: Scene, knowledge: Knowledge) -> FocusSensor:
    """Return the sensor for a `scene`, with the `knowledge` from a calibration."""
    psf = PsfModel(observation.frame_settings(scene, knowledge.ncpa_nm), TTF)
    effects = ramp_effects(observation.model_effects_of(scene), knowledge.effects)
    return FocusSensor(tabulated(ImageModel(psf, effects), torch.zeros(1, len(TTF), dtype=torch.float64)))


def two_by_two_sensors(scene: Scene, table: FrameTable | None = None) -> dict[str, FocusSensor]:
    """Return both sensors of a `scene` in the 2x2 mode, by name.

    With the `table` of its frames their own zero is known without any error, as from a perfect reference
    source: what they measure of the mean of all frames without defocus and noise.
    """
    settings = observation.settings_of(scene).for_broad_images().for_single_frames()
    model = ImageModel(light_path(settings, TTF), ramp_effects(observation.model_effects_of(scene), {}))
    sensors = {CENTROIDS: CentroidSensor(model, scene=scene), LIFT: FocusSensor(model)}
    if table is None:
        return sensors
    frames = range(table.series_e.shape[1])
    mean_e = np.mean([table.images_e(frame, np.zeros(1)) for frame in frames], axis=0)
    return {
        name: replace(one, zero_nm=float(one.measure(mean_e, WEIGHTS)[0])) for name, one in sensors.items()
    }


# -- loops -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loop:
    """One loop: its sensor by name, its star and gain, and the frames of the sky that an image collects."""

    sensor: str
    mag_j: float
    gain: float
    exposures: int = 1

    def brightness(self, mag_j: float) -> float:
        """Return the photons per second of its star over those of a star of magnitude `mag_j`."""
        return 10 ** (-0.4 * (self.mag_j - mag_j))


class Records(NamedTuple):
    """What loops have left behind, (loops, frames) each."""

    residual_nm: np.ndarray  # mean of drift minus command over each frame; NaN after a loop has diverged
    measured_nm: np.ndarray  # at the last frame of an exposure; NaN where there is no measurement
    true_nm: np.ndarray  # what a perfect sensor would measure: the mean residual of the exposure
    due: np.ndarray  # where a measurement was due


def close_loops(
    loops: Sequence[Loop],
    sensors: Mapping[str, FocusSensor],
    scenes: Mapping[int, Scene],
    table: FrameTable,
    drift_nm: np.ndarray,
    delay: int,
    rng: np.random.Generator,
) -> Records:
    """Run all loops over the same frames, with a `delay` in exposures of the loop, see `Integrator`.

    `scenes` are the sky by the frames of an exposure, `table` has its frames at any defocus, and `drift_nm`,
    (frames,), is the mean defocus of the disturbance in every frame: what it wanders within one is too little
    to change the image other than through its mean. The detector noise is drawn from `rng`.
    """
    shape = len(loops), len(drift_nm)
    gain, exposures = (np.array([getattr(loop, name) for loop in loops]) for name in ("gain", "exposures"))
    flux = np.array([loop.brightness(scenes[loop.exposures].mag_j) for loop in loops])[:, None, None]
    alike: dict[tuple[str, int], list[int]] = {}
    for place, loop in enumerate(loops):
        alike.setdefault((loop.sensor, loop.exposures), []).append(place)
    command_nm, alive = np.zeros(shape), np.ones(len(loops), dtype=bool)
    nothing, due = np.full((3, *shape), np.nan), np.zeros(shape, dtype=bool)
    found = Records(nothing[0], nothing[1], nothing[2], due)
    images_e = np.zeros((len(loops), *table.series_e.shape[2:]))
    for frame, drift in enumerate(drift_nm):
        left_nm = drift - command_nm[:, frame]
        alive &= np.abs(left_nm) <= table.reach_nm
        found.residual_nm[:, frame] = np.where(alive, left_nm, np.nan)
        # The first frame of an exposure begins a new image.
        kept_e = (frame % exposures != 0)[:, None, None] * images_e
        images_e = kept_e + flux * table.images_e(frame, np.where(alive, left_nm, 0.0))
        for (name, count), places in alike.items():
            members = np.array([place for place in places if alive[place]], dtype=int)
            if (frame + 1) % count or not len(members):
                continue
            seen_e = observation.recorded_e(scenes[count], images_e[members], rng)
            measured_nm = sensors[name].measure(seen_e, observation.noise_of(scenes[count]))
            found.due[members, frame], found.measured_nm[members, frame] = True, measured_nm
            exposed = slice(frame + 1 - count, frame + 1)
            found.true_nm[members, frame] = found.residual_nm[members, exposed].mean(axis=1)
            for member, nm in zip(members, measured_nm, strict=True):
                if np.isfinite(nm):  # without a measurement a command is held
                    command_nm[member, frame + 1 + delay * count :] += gain[member] * nm
    return found


def outcome_of(records: Records, drift: Drift, settle: int) -> dict[str, Any]:
    """Summarise one loop from its records, (skies, drifts, frames) each, `settle` frames left out.

    ``residual_nm`` is the RMS over time and over the runs that did not diverge, what wanders within a frame
    included, and ``residual_error_nm`` follows from the scatter between runs; ``bias_nm`` is the RMS over
    skies of the mean residual, ``lost`` the part of the measurements that the sensor could not give, and
    ``slope`` and ``noise_nm`` are those of measurement = slope × true residual + noise.
    """
    late = records.residual_nm[..., settle:]
    alive = np.isfinite(late).all(-1)
    squares = np.mean(late[alive] ** 2, axis=-1) + drift.wander_within_nm2(1.0)
    runs = len(squares)
    rms = float(np.sqrt(squares.mean())) if runs else math.nan
    means = [sky[fine].mean() for sky, fine in zip(late, alive, strict=True) if fine.any()]
    slope, noise_nm = sensor_of(records.measured_nm, records.true_nm)
    return {
        "residual_nm": rms,
        "residual_error_nm": np.std(squares, ddof=1) / np.sqrt(runs) / (2 * rms) if runs > 1 else math.nan,
        "bias_nm": float(np.sqrt(np.mean(np.square(means)))) if means else math.nan,
        "lost": np.mean(~np.isfinite(records.measured_nm[records.due])),
        "diverged": int((~alive).sum()),
        "runs": alive.size,
        "slope": slope,
        "noise_nm": noise_nm,
    }


def sensor_of(measured_nm: np.ndarray, true_nm: np.ndarray) -> tuple[float, float]:
    """Return the slope of measurement against truth, and the RMS about it; every sky has its own offset.

    `measured_nm`, `true_nm`, (skies, drifts, frames), are NaN where there is no measurement. Noise enters the
    truth only of later frames, so that a plain regression is unbiased.
    """
    pairs = []
    for m, t in zip(measured_nm, true_nm, strict=True):
        given = np.isfinite(m) & np.isfinite(t)
        pairs.append([one[given] - one[given].mean() if given.any() else one[given] for one in (m, t)])
    m, t = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    if len(m) < MIN_FOR_A_SLOPE:
        return math.nan, math.nan
    slope = float(m @ t / (t @ t))
    return slope, float(np.sqrt(np.sum((m - slope * t) ** 2) / (len(m) - len(pairs) - 1)))
