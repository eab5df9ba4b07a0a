"""The folder of a run as the calibration of a loop: for which frames it is, and how it is exchanged."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.estimate.focus import Focus, Limits
from irlos_pipe.estimate.lift import FrameErrors, spread_over
from irlos_pipe.estimate.unexplained import Structure, Unexplained
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.results import read_run_results, results_of
from irlos_pipe.product.run_table import read_checks
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.readers.acquisition import RawRecording, of_a_frame, resolve
from irlos_pipe.readers.sidecar import AcquisitionKeys, read_sidecar
from irlos_pipe.recipe.load import load_recipe
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.ingest.stage import recordings_from_product
from irlos_pipe.stages.lift.input import focus_sensor, read_ramp, single_frame_model, turned_text
from irlos_pipe.stages.lift.stage import Config, LiftResults
from irlos_pipe.stages.model.groups import OF_RAMPS

MISFIT = "misfit"
FEWEST_FRAMES = 6  # frames of a ramp that show how right exposures fit
# Amplitude of structure, and variance of motion, over those of the ramp from which an exposure is another:
# thousands of right ones, simulated in seeing of 0.3 to 1.3", stay below 3.2 and 3.3 times, halo allowed for.
# Motion matters where it imitates more defocus than this many times the most that the ramp shows.
STRUCTURE_TIMES, BLUR_TIMES, SHIFT_TIMES = 4.0, 4.0, 3.0
NOISE_TIMES = 5.0  # errors by noise that are allowed besides
WEIGHTED_AS_FOR = (1.0, 0.1, 0.01)  # part of the noise that weights are for: less gives the core more weight
# Part of the light that the AO residual of a usual night leaves in the halo: speckles grow with it, and it
# cannot be less than none; and what the worst seeing takes from the core.
HALO, MOST_HALO = 0.2, 0.5
USUAL_STRUCTURE, USUAL_BLUR_PX2, USUAL_HALO, USUAL_SHIFT_NM = 0.0024, 0.12, 0.05, 4.0  # where no ramp shows

LOG = logging.getLogger(__name__)
QC_FAILED = "qc_failed"  # status in results.json
LOOK_S = 1.0  # between looks at a run folder for another calibration
PART = 1e-3  # relative difference of spectrum, pixel scale or gain: side-cars are rounded to less
DIVERSITY_NM = 0.5  # difference of a mode of the diversity from which it is another


@dataclass(frozen=True, eq=False)
class Ordinary:
    """What right exposures show beyond the model."""

    frames: int  # of the ramp that has shown it; 0 for values of simulated exposures
    structure: np.ndarray  # (weights,), median of the rest, see `Structure`, for each of `WEIGHTED_AS_FOR`
    largest_structure: np.ndarray  # (weights,), its maximum
    blur_px2: float  # RMS of the variance of image motion
    halo: float  # the largest
    shift_nm: float  # of the defocus, the largest

    @classmethod
    def of(cls, sensor: Focus, images_e: Iterable[np.ndarray]) -> Ordinary:
        """Return what a `sensor` sees in frames of a ramp, `images_e`; the usual if they are too few."""
        seen: list[Unexplained] = []
        structure: list[list[float]] = []
        for image_e in images_e:
            measured, found = sensor.solved(image_e)
            if found is None or not measured.valid:
                continue
            beside = sensor.beside(found)
            seen.append(beside)
            structure.append([one.rest for one in _structures(beside)])
        if len(seen) < FEWEST_FRAMES:
            return cls.usual()
        return cls(
            len(seen),
            np.median(structure, axis=0).clip(0),
            np.max(structure, axis=0).clip(0),
            math.sqrt(np.mean([one.blur_px2**2 for one in seen])),
            max(one.halo for one in seen),
            max(abs(one.shift_nm) for one in seen),
        )

    @classmethod
    def usual(cls) -> Ordinary:
        """Return what simulated exposures in good seeing show."""
        structure = np.full(len(WEIGHTED_AS_FOR), USUAL_STRUCTURE**2)
        return cls(0, structure, 4 * structure, USUAL_BLUR_PX2, USUAL_HALO, USUAL_SHIFT_NM)

    def fits(self, found: Unexplained, largest: float) -> bool:
        """Return whether what is `found` beyond the model is no more than right exposures may have.

        The `largest` part of the light may at most be unexplained, whatever the ramp shows.
        """
        blur_px2 = math.hypot(BLUR_TIMES * self.blur_px2, NOISE_TIMES * found.blur_sigma_px2)
        noise = NOISE_TIMES * found.halo_sigma
        moved = abs(found.blur_px2) > blur_px2 or not -HALO - noise <= found.halo <= MOST_HALO + noise
        if moved and abs(found.shift_nm) > SHIFT_TIMES * self.shift_nm:
            return False
        times = STRUCTURE_TIMES**2 * self._speckled(found)
        for usual, one in zip(self.structure, _structures(found), strict=True):
            sigma, most = NOISE_TIMES * one.sigma, largest**2 * one.star
            if one.rest > math.hypot(min(times * usual, most), sigma) or one.whole > math.hypot(most, sigma):
                return False
        return True

    def growth(self, found: Unexplained) -> tuple[float, float]:
        """Return the growth of errors by structure and halo beyond the ramp's, and one by motion [nm]."""
        structure, largest = found.rest.structure(found.rest.level), self.largest_structure[0]
        factor2 = self._speckled(found)
        if largest > 0:
            factor2 *= max(1.0, (structure.rest - structure.sigma) / largest)
        beyond_nm2 = found.shift_nm**2 - found.shift_sigma_nm**2 - self.shift_nm**2
        return math.sqrt(factor2), math.sqrt(max(beyond_nm2, 0.0))

    def _speckled(self, found: Unexplained) -> float:
        """By how much the light of speckles is more than the ramp's, as far as the halo is surely larger."""
        return 1 + max(found.halo - 2 * found.halo_sigma - self.halo, 0.0) / HALO


def _structures(found: Unexplained) -> list[Structure]:
    return [found.rest.structure(found.rest.level * part) for part in WEIGHTED_AS_FOR]


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """From the error by photons to that of the measurement, as the stage `lift` states it."""

    frames: FrameErrors  # growth by misfit, and error of the instant
    defocus_nm: np.ndarray  # (offsets,), in order
    shared_nm: np.ndarray  # (offsets,), error by the known wavefront there, and an offset of the ramp

    @classmethod
    def of(cls, results: LiftResults) -> SharedErrors | None:
        """Return those that a ramp has shown; None where it was measured without the NCPAs, or not at all."""
        defocus_nm = np.array([point.defocus_nm for point in results.points])
        chosen = spread_over(defocus_nm)
        if not results.calibrated or not len(chosen):
            return None
        shared_nm = [math.hypot(one.sigma_optics_nm, one.sigma_offset_nm) for one in results.points]
        frames = FrameErrors(results.points[0].sigma_instant_nm, results.chi2_nu, results.nominal_chi2_nu)
        return cls(frames, defocus_nm[chosen], np.array(shared_nm)[chosen])

    def sigma_nm(
        self, defocus_nm: float, photon_nm: float, growth: float = 1.0, beside_nm: float = 0.0
    ) -> float:
        """Return the standard error of `defocus_nm`, whose error by photons and read-out is `photon_nm` [nm].

        `growth` is by how much that and the error of the instant are larger than those of the ramp's frames,
        `beside_nm` a further error; see `Ordinary.growth`.
        """
        shared_nm = np.interp([defocus_nm], self.defocus_nm, self.shared_nm)
        frames = replace(self.frames, instant_nm=math.hypot(growth * self.frames.instant_nm, beside_nm))
        return float(frames.sigma_nm(np.array([growth * photon_nm]), shared_nm)[0])


Spectrum = Sequence[tuple[float, float]]
_Frames = tuple[Recording, np.ndarray, NoiseModel, Iterable[np.ndarray]]


@dataclass(frozen=True, eq=False)
class Calibration:
    sensor: Focus
    name: str  # of the run, with a part of the checksum of all that its calibration depends on
    instrument: Instrument
    instrument_name: str
    acquisition: Acquisition  # of the frames to be measured
    made_unix_s: float  # of the recording behind it; NaN if not known
    errors: SharedErrors | None = None  # besides those by photons; None without a ramp that shows them
    ordinary: Ordinary = field(default_factory=Ordinary.usual)  # how right exposures fit
    notice: str = ""  # what has to be said before any result, as of samples

    @property
    def window(self) -> tuple[int, int]:
        return self.sensor.window


@dataclass(frozen=True)
class CalibrationRequest:
    """Which calibration a loop is to use."""

    run: Path  # folder of a run with the stage `calibrate`
    acquisition: Path | None = None  # side-car of the loop's frames; by default these are as the run's ramp
    window: tuple[int, int] | None = None  # of the frames, where nothing else says it
    limits: Limits = field(default_factory=Limits)
    despite_qc: bool = False  # take a run whose QC has failed, too

    def load(self) -> Calibration:
        """Read the run.

        Raises `InputDataError` when the folder is not that of a run with a calibration, or of one whose QC
        has failed; `ConfigurationError` when its model cannot measure single frames.
        """
        folder = existing_run(self.run)
        paths = folder.products()
        if not {"ingest", "calibrate"} <= {*paths}:
            raise InputDataError(
                f"{self.run}: holds no calibration; run a recipe with the stages ingest and calibrate first"
            )
        whole = read_run_results(folder.results)
        if whole.status == QC_FAILED and not self.despite_qc:
            raise InputDataError(
                f"{self.run}: its QC has failed ({_failed_checks(folder)}); mend the calibration, or take it "
                "with --despite-qc"
            )
        recipe = load_recipe(folder.recipe, needed="none")
        products = {name: open_product(paths[name]) for name in ("ingest", "calibrate")}
        told = dict(recipe.configs.get("lift", Config()))
        config = Config(**told | {"calibrated": True, "halo": "calibrated"})
        model, instrument, seed = recipe.model, recipe.instrument, recipe.seed
        ctx = StageContext(config, model, instrument, {}, products, "cpu", seed, 1, _no_progress, LOG, Path())
        recording, good, noise, images_e = self._frames(ctx)
        if recording.acquisition.lenslets > 1:
            raise ConfigurationError(
                f"{self.run}: its ramp has frames of a 2x2 mode, and the loop measures images of the full "
                "pupil; describe those with --acquisition FILE"
            )
        sensor = focus_sensor(
            single_frame_model(ctx, recording), good, noise, self._limits(recording.acquisition)
        )
        ordinary = Ordinary.of(sensor, images_e)
        notices = [whole.notice, turned_text(ctx, recording.acquisition)]
        if not ordinary.frames:
            notices.append("no ramp shows how right frames fit; simulated ones set the limits")
        errors = None
        if "lift" in paths:
            errors = SharedErrors.of(results_of(LiftResults, open_product(paths["lift"])))
        key = str(products["calibrate"].provenance.get("key", ""))[:12]
        starts = [one.start_unix_s for one in recordings_from_product(products["ingest"])]
        return Calibration(
            sensor,
            f"{self.run.resolve().name}:{key}",
            recipe.instrument,
            recipe.instrument_name,
            recording.acquisition,
            min((one for one in starts if math.isfinite(one)), default=math.nan),
            errors,
            ordinary,
            "; ".join(filter(None, notices)),
        )

    def _limits(self, acquisition: Acquisition) -> Limits:
        """With the saturation of the detector, where it is known."""
        detector = acquisition.detector
        if detector.saturation_adu is None or math.isfinite(self.limits.saturation_e):
            return self.limits
        return replace(self.limits, saturation_e=detector.saturation_adu * detector.e_per_adu)

    def _frames(self, ctx: StageContext[Config]) -> _Frames:
        """How frames are taken, good pixels, the noise of one, and those of the ramp."""
        if self.acquisition is None:
            recordings = recordings_from_product(ctx.products["ingest"])
            if not any(
                one.input == ctx.config.input and one.acquisition.role in OF_RAMPS for one in recordings
            ):
                raise ConfigurationError(
                    f"{self.run}: has no input '{ctx.config.input}' that says how the frames of the loop are "
                    "taken; describe them with --acquisition FILE"
                )
            ramp = read_ramp(ctx, ctx.config.input)
            return ramp.recordings[0], ramp.data.good.numpy(), ramp.data.noise, ramp.data.images_e.numpy()
        calibrated = recordings_from_product(ctx.products["ingest"])[0]
        window = self.window or calibrated.window
        good = calibrated.good if calibrated.window == window else np.ones(window, bool)
        recording = _described(self.acquisition, window, ctx.instrument)
        return recording, good, NoiseModel.of(recording), []


def _failed_checks(folder: RunFolder) -> str:
    """Names of the checks that failed, as far as they can be read."""
    try:
        names = [f"'{one['name']}'" for one in read_checks(folder) if not one["passed"]]
    except InputDataError:
        names = []
    return f"{names[0]}{and_more(names)}" if names else f"see {folder.quality}"


def _no_progress(*_: object, **__: object) -> None:
    raise NotImplementedError("a loop shows no progress bars")


def _described(path: Path, window: tuple[int, int], instrument: Instrument) -> Recording:
    """A recording without frames, taken as a side-car says."""
    if not path.is_file():
        raise InputDataError(f"{path}: no such file; give a side-car, as irlos sidecar writes it")
    empty, nothing, none = np.zeros((0, *window), np.float32), np.zeros(0, np.int64), np.zeros(0)
    raw = RawRecording(
        name=path.stem, path=path.with_suffix(".fits"), layout="", adu=empty, frame_counter=nothing
    )
    keys = read_sidecar(path).model_copy(update={"introduced_defocus_nm": 0.0})
    acquisition = resolve(raw, keys, instrument).acquisition
    used, why, good = none.astype(bool), none.astype(str), np.ones(window, bool)
    return Recording(raw.name, "", empty, used, why, good, none, nothing, none, acquisition)


# -- whether frames are taken as those that a calibration is for -----------------------------------------


def optical_differences(frames: Acquisition, calibrated: Acquisition) -> list[str]:
    """Return what makes images of `frames` others than those `calibrated`, an item for each key."""
    found = [
        *_of_spectrum(frames.spectrum, calibrated.spectrum),
        *_of_number("pixel_scale_mas", frames.pixel_scale_mas, calibrated.pixel_scale_mas),
        *_of_diversity(frames.diversity, calibrated.diversity),
    ]
    if frames.lenslets != calibrated.lenslets:
        found.append(f"{frames.lenslets}x{frames.lenslets} lenslets, not {calibrated.lenslets}")
    return found


def exposure_differences(frames: Acquisition, calibrated: Acquisition) -> list[str]:
    """Return what makes the noise of `frames` another than of those `calibrated`, where both are known."""
    here, there = frames.detector, calibrated.detector
    return [
        *_of_number("exposure_s", frames.exposure_s, calibrated.exposure_s),
        *_of_number("read_noise_e", here.read_noise_e, there.read_noise_e),
        *_of_number("excess_noise_factor", here.excess_noise_factor, there.excess_noise_factor),
    ]


def stated_differences(keys: AcquisitionKeys, calibrated: Acquisition) -> list[str]:
    """Return what the `keys` of a side-car state otherwise than `calibrated`; what they leave out agrees."""
    stated = keys.flat()
    found = ["role dark"] if stated.get("role") == "dark" else []
    if "spectrum" in stated:
        spectrum = [(one.wavelength_nm, one.weight) for one in stated["spectrum"]]
        found += _of_spectrum(spectrum, calibrated.spectrum)
    if "diversity" in stated:
        found += _of_diversity(stated["diversity"].zernike, calibrated.diversity)
    found += _of_number("pixel_scale_mas", stated.get("pixel_scale_mas"), calibrated.pixel_scale_mas)
    gain = stated_detector(keys, calibrated).e_per_adu
    found += _of_number("detector.e_per_adu", gain, calibrated.detector.e_per_adu)
    return found


def stated_detector(keys: AcquisitionKeys, calibrated: Acquisition) -> Detector:
    """Return the constants of a frame: those that the `keys` of a side-car state, else as `calibrated`."""
    stated = keys.flat()
    reads = calibrated.detector.reads if "detector.read_s" in stated else 1
    return replace(calibrated.detector, **of_a_frame(stated, stated.get("detector.coadds", reads)))


def _of_number(name: str, here: float | None, there: float | None) -> Iterator[str]:
    if here is not None and there is not None and abs(here - there) > PART * abs(there):
        yield f"{name} {here:g}, not {there:g}"


def _of_spectrum(here: Spectrum, there: Spectrum) -> Iterator[str]:
    one, other = _normal(here), _normal(there)
    if one.shape != other.shape or not np.allclose(one, other, rtol=PART, atol=PART):
        yield f"spectrum {_text(one)}, not {_text(other)}"


def _normal(spectrum: Spectrum) -> np.ndarray:
    """Wavelengths in order, and weights of sum 1; without those of no weight."""
    lit = np.array(sorted(one for one in spectrum if one[1] > 0), float).reshape(-1, 2)
    return lit / [1.0, max(lit[:, 1].sum(), 1e-300)]


def _text(spectrum: np.ndarray) -> str:
    wavelengths = "+".join(f"{nm:.0f}" for nm in spectrum[:, 0])
    return f"{wavelengths} nm ({'+'.join(f'{weight:.2f}' for weight in spectrum[:, 1])})"


def _of_diversity(here: dict[int, float], there: dict[int, float]) -> Iterator[str]:
    for noll in sorted({*here, *there}):
        one, other = here.get(noll, 0.0), there.get(noll, 0.0)
        if abs(one - other) > DIVERSITY_NM:
            yield f"diversity of Noll {noll} {one:g} nm, not {other:g}"


# -- another calibration while the loop runs -----------------------------------------------------------


@dataclass
class CalibrationWatch:
    """Looks whether a run folder, or the link to one, has a new calibration; a thread makes it ready."""

    request: CalibrationRequest
    current: Calibration  # in use
    _looked_s: float = field(default_factory=time.monotonic)
    _worker: threading.Thread | None = None
    _found: Calibration | str | None = None

    def __post_init__(self) -> None:
        self._stamp = self._present_stamp()

    def news(self) -> Calibration | str | None:
        """Return what has come since the last call: a calibration, or what is wrong with one."""
        if self._worker is not None and not self._worker.is_alive():
            self._worker = None
            found, self._found = self._found, None
            if isinstance(found, Calibration):
                self.current = found
            return found
        if self._worker is None and time.monotonic() - self._looked_s > LOOK_S:
            self._looked_s, stamp = time.monotonic(), self._present_stamp()
            if stamp is not None and stamp != self._stamp:
                self._stamp = stamp
                self._worker = threading.Thread(target=self._load, daemon=True)
                self._worker.start()
        return None

    def _present_stamp(self) -> tuple[int, ...] | None:
        """Of the file that a run writes last; None where there is none."""
        try:
            stat = RunFolder(self.request.run).results.stat()
        except OSError:
            return None
        return stat.st_dev, stat.st_ino, stat.st_mtime_ns

    def _load(self) -> None:
        try:
            new = self.request.load()
            require_exchangeable(self.current, new)
        except IrlosError as error:
            self._found = " ".join(str(error).split())
        except Exception as error:  # the loop goes on with what it has, whatever is wrong with the other
            LOG.debug("calibration", exc_info=True)
            self._found = f"{self.request.run}: cannot be used: {type(error).__name__}: {error}"
        else:
            self._found = new if new.name != self.current.name else None


def require_exchangeable(old: Calibration, new: Calibration) -> None:
    """Raise InputDataError unless a `new` calibration is for what the `old` one is for."""
    against = optical_differences(new.acquisition, old.acquisition)
    if new.instrument_name != old.instrument_name:
        problem = f"of instrument {new.instrument_name}, and the loop runs on {old.instrument_name}"
    elif new.window != old.window:
        there = f"{old.window[0]}x{old.window[1]}"
        problem = f"for frames of {new.window[0]}x{new.window[1]} px, the loop has {there}"
    elif against:
        problem = f"for other frames than the loop has: {'; '.join(against)}"
    else:
        return
    raise InputDataError(f"{new.name}: a calibration {problem}")
