"""The folder of a run as the calibration of a loop."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.estimate.focus.sensor import Focus, Limits
from irlos_pipe.files.regular import read_regular
from irlos_pipe.focus.ordinary import Ordinary
from irlos_pipe.focus.shared_errors import SharedErrors
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.results import read_run_results, results_of
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.sidecar import read_sidecar
from irlos_pipe.recipe.load import Recipe, load_recipe
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.lift.fit import focus_sensor, light_path
from irlos_pipe.stages.lift.input import ROLES, read_ramp
from irlos_pipe.stages.lift.results import LiftResults
from irlos_pipe.stages.lift.stage import Config

LOG = logging.getLogger(__name__)
QC_FAILED = "qc_failed"  # as results.json says
_Frames = tuple[Recording, np.ndarray, NoiseModel, Iterable[np.ndarray]]


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a loop measures with.

    Attributes
    ----------
    sensor : Focus
    name : str
        Of the run, with a part of the checksum of all that its calibration depends on.
    instrument : Instrument
    instrument_name : str
    acquisition : Acquisition
        Of the frames to be measured.
    made_unix_s : float
        Time of the recording behind it; NaN if not known.
    errors : SharedErrors or None
        Beside those by photons; None where the run has no ramp that tells them.
    ordinary : Ordinary
        How right exposures fit.
    notice : str
        What has to be said before any result, as of samples; empty if nothing has to be.
    """

    sensor: Focus
    name: str
    instrument: Instrument
    instrument_name: str
    acquisition: Acquisition
    made_unix_s: float
    errors: SharedErrors | None = None
    ordinary: Ordinary = field(default_factory=Ordinary.usual)
    notice: str = ""

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns of the frames."""
        return self.sensor.window


@dataclass(frozen=True)
class CalibrationRequest:
    """Which calibration a loop is to use.

    Attributes
    ----------
    run : Path
        Folder of a run with the stage `calibrate`.
    acquisition : Path or None
        Side-car that says how the loop's frames are taken; by default as those of the run's ramp.
    window : (int, int) or None
        Of the frames, where nothing else says it.
    limits : Limits
    despite_qc : bool
        Take a run whose QC has failed, too.
    """

    run: Path
    acquisition: Path | None = None
    window: tuple[int, int] | None = None
    limits: Limits = field(default_factory=Limits)
    despite_qc: bool = False

    def load(self) -> Calibration:
        """Read the run.

        Raises
        ------
        InputDataError
            When the folder is not that of a run with a calibration, or of one whose QC has failed.
        ConfigurationError
            When its model cannot measure single frames.
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
        recipe = load_recipe(folder.recipe, complete=False)
        products = {name: open_product(paths[name]) for name in ("ingest", "calibrate")}
        config = recipe.configs.get("lift", Config())
        assert isinstance(config, Config)
        ctx = _context(recipe, products, config)
        recording, good, noise, images_e = self._frames(ctx)
        _require_full_pupil(self.run, recording)
        sensor = focus_sensor(light_path(ctx, recording), good, noise, self._limits(recording.acquisition))
        ordinary = Ordinary.of(sensor, images_e)
        unknown = (
            "" if ordinary.frames else "no ramp shows how right frames fit; simulated ones set the limits"
        )
        key = str(products["calibrate"].provenance.get("key", ""))[:12]
        starts = [one.start_unix_s for one in recordings_from_product(products["ingest"])]
        return Calibration(
            sensor,
            f"{self.run.resolve().name}:{key}",
            recipe.instrument,
            recipe.instrument_name,
            recording.acquisition,
            min((one for one in starts if math.isfinite(one)), default=math.nan),
            SharedErrors.of(results_of(LiftResults, open_product(paths["lift"])))
            if "lift" in paths
            else None,
            ordinary,
            "; ".join(filter(None, (whole.notice, unknown))),
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
            return _like_the_ramp(ctx, self.run)
        calibrated = recordings_from_product(ctx.products["ingest"])[0]
        window = self.window or calibrated.window
        good = calibrated.good if calibrated.window == window else np.ones(window, bool)
        recording = _described(self.acquisition, window, ctx.instrument)
        return recording, good, NoiseModel.of(recording), []


def _failed_checks(folder: RunFolder) -> str:
    """Names of the checks that failed, as far as they can be read."""
    try:
        checks = json.loads(read_regular(folder.quality))["checks"]
        names = [f"'{one['name']}'" for one in checks if not one["passed"]]
    except (OSError, ValueError, KeyError, TypeError):
        names = []
    return f"{names[0]}{and_more(names)}" if names else f"see {folder.quality}"


def _require_full_pupil(run: Path, recording: Recording) -> None:
    if recording.acquisition.lenslets > 1:
        raise ConfigurationError(
            f"{run}: its ramp has frames of a 2x2 mode, and the loop measures images of the full pupil; "
            "describe those with --acquisition FILE"
        )


def _context(recipe: Recipe, products: dict, config: Config) -> StageContext[Config]:
    return StageContext(
        config,
        recipe.model,
        recipe.instrument,
        {},
        products,
        "cpu",
        recipe.seed,
        1,
        _no_progress,
        LOG,
        Path(),
    )


def _no_progress(*_: object, **__: object) -> None:
    raise NotImplementedError("a loop shows no progress bars")


def _like_the_ramp(ctx: StageContext[Config], run: Path) -> _Frames:
    """As the stage `lift` takes the run's own ramp."""
    recordings = recordings_from_product(ctx.products["ingest"])
    if not any(one.input == ctx.config.input and one.acquisition.role in ROLES for one in recordings):
        raise ConfigurationError(
            f"{run}: has no input '{ctx.config.input}' that says how the frames of the loop are taken; "
            "describe them with --acquisition FILE"
        )
    ramp = read_ramp(ctx, ctx.config.input)
    return ramp.recordings[0], ramp.data.good.numpy(), ramp.data.noise, ramp.data.images_e.numpy()


def _described(path: Path, window: tuple[int, int], instrument: Instrument) -> Recording:
    """A recording without frames, taken as a side-car says."""
    if not path.is_file():
        raise InputDataError(f"{path}: no such file; give a side-car, as irlos sidecar writes it")
    empty = np.zeros((0, *window), np.float32)
    nothing = np.zeros(0, np.int64)
    raw = RawRecording(
        name=path.stem, path=path.with_suffix(".fits"), layout="", adu=empty, frame_counter=nothing
    )
    keys = read_sidecar(path).model_copy(update={"introduced_defocus_nm": 0.0})
    acquisition = resolve(raw, keys, instrument).acquisition
    none = np.zeros(0)
    return Recording(
        raw.name,
        "",
        empty,
        none.astype(bool),
        none.astype(str),
        np.ones(window, bool),
        none,
        nothing,
        none,
        acquisition,
    )
