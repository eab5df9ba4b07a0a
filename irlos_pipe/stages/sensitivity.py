"""Stage `sensitivity`: defocus error against magnitude, with and without NCPAs, few and many modes."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from math import nan
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import field_validator

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.units import MEDIAN_OF_NORMAL
from irlos_pipe.files.processes import require_memory
from irlos_pipe.frames.noise import ExposureNoise, NoiseModel
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Quantity, declared
from irlos_pipe.product.results import DITTO, Number, ResultsPart, StageResults, item
from irlos_pipe.stages.base import Declared, StageConfig, StageContext, StageOutput
from irlos_pipe.stages.lift.stage import Mode

if TYPE_CHECKING:
    from irlos_pipe.estimate.sensitivity import Configuration, Criterion, Curve
    from irlos_pipe.instrument.instrument import Instrument
    from irlos_pipe.stages.lift.input import Ramp

VERSION = 12
NEEDS = ("ingest",)
READS = ("prior", "calibrate")
CURVE = {
    "mag_j": ("mag", "magnitude", "J magnitude of the dimmed star"),
    "median_abs_error_nm": ("nm", "magnitude", "median of |estimated − introduced|"),
    "p16_nm": ("nm", "magnitude", "16th percentile of |estimated − introduced|"),
    "p84_nm": ("nm", "magnitude", "84th percentile of |estimated − introduced|"),
    "crb_nm": ("nm", "magnitude", "Cramér–Rao bound, 1σ"),
    "one_read_crb_nm": ("nm", "magnitude", "the same for one read without sky"),
    "failures": ("", "magnitude", "estimates that failed"),
}
ARRAYS = {f"curves/<n>/{name}": what for name, what in CURVE.items()}
BYTES_PER_PIXEL = 40  # memory for every image that is estimated at once; 24 to 29 were measured with 48x48 px
MANY = 20_000  # estimates from which a scan takes minutes: a processor makes 50 to 500 per second


class Config(StageConfig):
    """Settings of the sensitivity scan."""

    input: str = item("ramp", "recipe input that holds the ramp")
    max_defocus_nm: float = item(170.0, "frames with a larger introduced defocus are left out", gt=0)
    mag_step: float = item(1.0, "step of the magnitude grid", ge=0.05, le=5)
    faintest_mag_j: float = item(
        19.0, "end of the magnitude grid, which begins at the magnitude of the ramp", ge=0, le=30
    )
    realisations: int = item(5, "noise realisations per frame and magnitude", ge=1, le=1000)
    frames_per_offset: int = item(2, "number of frames used of every offset", ge=1, le=1000)
    modes: tuple[tuple[Mode, ...], ...] = item(
        ((2, 3, 4), (2, 3, 4, 5, 7, 8, 9, 10, 11)), "sets of Noll modes to be estimated", max_length=20
    )
    calibrated: tuple[bool, ...] = item((True, False), "whether the NCPAs are known: with, without, or both")
    limit_nm: float = item(30.0, "largest median error at the limiting magnitude [nm RMS]", gt=0)
    limit_failures: float = item(0.1, "largest part of failures at the limiting magnitude", ge=0, le=1)
    noise: Literal["reads", "recorded"] = item(
        "reads",
        "noise of the dimmed frames: of all the reads of an exposure, with sky and dark current; "
        "or as the frames were recorded, which in simulations may be one read without sky",
    )

    @field_validator("modes")
    @classmethod
    def _focus_among_them(cls, modes: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        if any(4 not in one for one in modes):
            raise ValueError("every set of modes must hold 4 (defocus)")
        if any(len({*one}) < len(one) for one in modes):
            raise ValueError("a mode stands twice in a set; name it once")
        return modes


class NoiseRow(ResultsPart):
    """Noise of the dimmed frames, beside that of exposures of one read without sky."""

    reads: int | None = item(None, "Reads in an exposure.")
    exposure_s: Number = item(nan, "Exposure of a frame.")
    read_noise_e: Number = item(nan, "Read noise of one read.")
    excess_noise_factor: Number = item(nan, "Variance of the photons over that of Poisson.")
    sky_e: Number = item(nan, "Electrons of sky and of dark current in a pixel of an exposure.")
    dark_e: Number = item(nan, DITTO)
    floor_e2: Number = item(nan, "Variance of a pixel without star.")
    one_read_floor_e2: Number = item(nan, DITTO)


class CurveRow(ResultsPart):
    """One curve over the magnitudes `mag_j`."""

    calibrated: bool = item(False, "Whether the NCPAs are part of the known wavefront.")
    modes: list[int] = item([], "Estimated modes (Noll).")
    mag_j: list[Number] = item([], "J magnitudes, to which the frames were dimmed.")
    median_abs_error_nm: list[Number] = item([], "Percentiles of |estimated − introduced| defocus.")
    p16_nm: list[Number] = item([], DITTO)
    p84_nm: list[Number] = item([], DITTO)
    crb_nm: list[Number] = item([], "Cramér–Rao bound, 1σ; and of exposures of one read without sky.")
    one_read_crb_nm: list[Number] = item([], DITTO)
    failures: list[int] = item([], "Estimates that failed, of `trials` per magnitude.")
    trials: int | None = item(None, "Estimates per magnitude.")
    limit_mag: Number = item(nan, "Faintest magnitude that meets the criterion; NaN if none does.")
    one_read_bound_mag: Number = item(
        nan, "Limiting magnitude of an efficient estimate from exposures of one read without sky."
    )

    @property
    def label(self) -> str:
        """How the frames were estimated."""
        return f"{'with' if self.calibrated else 'without'} NCPAs, {len(self.modes)} modes"

    @property
    def at_the_end(self) -> bool:
        """Whether the magnitudes end before the criterion is missed."""
        return bool(self.mag_j) and self.limit_mag == self.mag_j[-1]

    def values(self, name: str) -> np.ndarray:
        """Return one of the lists, (magnitudes,); NaN where a product of an earlier version lacks it."""
        found = getattr(self, name)
        return np.array(found, float) if found else np.full(len(self.mag_j), nan)


class CriterionRow(ResultsPart):
    """What a limiting magnitude keeps: largest median error, and largest part of failures."""

    median_abs_error_nm: Number = item(nan, "Largest median of |estimated − introduced| defocus.")
    failures: Number = item(nan, "Largest part of the estimates that may fail.")


class SensitivityResults(StageResults):
    """One curve per combination of modes and calibration."""

    stage: ClassVar[str] = "sensitivity"
    curves: list[CurveRow] = []
    criterion: CriterionRow = CriterionRow()
    noise: NoiseRow = NoiseRow()
    crb_note: str = item("", "How the Cramér–Rao bounds compare with the median errors.")


Results = SensitivityResults


def require(declared: Declared[Config]) -> None:
    """See `Stage`."""
    _magnitudes(declared.recordings[0], declared.config)


def _magnitudes(recording: Recording, config: Config) -> np.ndarray:
    """To which the frames are dimmed, from that of the first recording of the ramp on."""
    bright = recording.acquisition.mag_j
    if bright is None:
        raise InputDataError(
            f"{recording.name}: mag_j is missing; give it in acquisition.yaml, "
            "the magnitudes of the dimmed frames are counted from it"
        )
    magnitudes = np.arange(bright, config.faintest_mag_j + 1e-9, config.mag_step)
    if len(magnitudes) == 0:
        raise InputDataError(
            f"sensitivity.faintest_mag_j {config.faintest_mag_j} is brighter than the ramp's "
            f"own m_J {bright}: frames can only be dimmed"
        )
    return magnitudes


def run(ctx: StageContext[Config]) -> StageOutput:
    """Scan every combination of modes and calibration."""
    from irlos_pipe.estimate.sensitivity import Criterion, scan
    from irlos_pipe.numerics.parallel import process_map
    from irlos_pipe.stages.lift.input import read_ramp

    ramp = read_ramp(ctx, ctx.config.input)
    magnitudes = _magnitudes(ramp.recordings[0], ctx.config)
    bright = float(magnitudes[0])
    chosen = torch.as_tensor(_choose(ramp, ctx.config))
    faint, one_read, noise = _noises_of(ramp, bright, ctx.instrument, ctx.config.noise)
    combinations = [(calibrated, nolls) for calibrated in ctx.config.calibrated for nolls in ctx.config.modes]
    window = ramp.recordings[0].window
    announce(len(chosen), window, ctx.config.realisations, len(magnitudes), len(combinations), ctx.log)
    estimates = len(combinations) * len(magnitudes) * len(chosen) * ctx.config.realisations
    criterion = Criterion(ctx.config.limit_nm, ctx.config.limit_failures)
    configurations = process_map(lambda one: _bright(ctx, ramp, chosen, *one), combinations)
    with ctx.progress(total=estimates, desc="sensitivity") as bar:
        curves = scan(
            configurations,
            ramp.data.of(chosen),
            bright,
            magnitudes,
            ctx.config.realisations,
            criterion,
            ctx.seed,
            faint=faint,
            one_read=one_read,
            report=bar.update,
        )
    return _output(criterion, combinations, curves, noise)


def _choose(ramp: Ramp, config: Config) -> np.ndarray:
    """Numbers of the frames used: the first few of every offset within reach."""
    introduced = ramp.data.introduced_nm
    chosen = [
        i
        for value in np.unique(introduced[np.abs(introduced) <= config.max_defocus_nm])
        for i in np.flatnonzero(introduced == value)[: config.frames_per_offset]
    ]
    if not chosen:
        raise InputDataError(
            f"no frame of the ramp has |introduced defocus| <= {config.max_defocus_nm} nm; "
            "raise sensitivity.max_defocus_nm"
        )
    return np.array(sorted(chosen))


def _bright(
    ctx: StageContext[Config], ramp: Ramp, chosen: torch.Tensor, calibrated: bool, nolls: tuple[int, ...]
) -> Configuration:
    """The frames as they are, whose model gives the noise-free signal and the start."""
    from irlos_pipe.estimate.calibration_options import LiftOptions
    from irlos_pipe.estimate.ramp_fit import fit_ramp
    from irlos_pipe.estimate.sensitivity import Configuration
    from irlos_pipe.stages.lift.input import calibrated_ncpa_nm, effects_for_lift, ramp_model, ramp_start

    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, nolls, ncpa_nm)
    start_nm = ramp_start(ctx, model, ramp, ncpa_nm, "elongation")[chosen]
    effects = effects_for_lift(ctx, ramp.recordings[0], "calibrated", "calibrated", calibrated=calibrated)
    return Configuration.of(fit_ramp(model, ramp.data.of(chosen), start_nm, LiftOptions(), effects))


def _output(
    criterion: Criterion,
    combinations: Sequence[tuple[bool, tuple[int, ...]]],
    curves: Sequence[Curve],
    noise: NoiseRow,
) -> StageOutput:
    rows: list[CurveRow] = []
    arrays: dict[str, Quantity] = {}
    for number, ((calibrated, nolls), curve) in enumerate(zip(combinations, curves, strict=True)):
        values = {name: getattr(curve, name) for name in CURVE}
        note = f"NCPAs {'added' if calibrated else 'left out'}, {len(nolls)} modes"
        arrays |= declared(CURVE, values, note, below=f"curves/{number}/")
        own = {"calibrated": calibrated, "modes": list(nolls)}
        own["one_read_bound_mag"] = curve.bound_mag(criterion)
        rows.append(CurveRow.filled_from(curve, **own))
    level = CriterionRow(median_abs_error_nm=criterion.median_nm, failures=criterion.failure_fraction)
    note = f"1 sigma; the median |error| of an efficient estimate is {MEDIAN_OF_NORMAL} of it"
    results = SensitivityResults(curves=rows, criterion=level, noise=noise, crb_note=note)
    lines = [
        f"Noise           {_noise_text(noise)}",
        f"Limit           median |error| ≤ {criterion.median_nm:.0f} nm, "
        f"failures ≤ {criterion.failure_fraction:.0%}:",
        *(f"  {row.label}: {_limit_text(row)}" for row in rows),
    ]
    return StageOutput(arrays, results, summary=lines)


def _noise_text(noise: NoiseRow) -> str:
    """Return the noise of the dimmed frames in words."""
    if noise.reads is None:
        return f"{noise.floor_e2:.3g} e⁻² per pixel, as recorded"
    ratio = noise.floor_e2 / noise.one_read_floor_e2
    sky = (noise.sky_e + noise.dark_e) * noise.excess_noise_factor
    return (
        f"{noise.reads} reads of {noise.read_noise_e:.2g} e⁻ in {noise.exposure_s:g} s, sky and dark "
        f"{sky:.2g} e⁻²: {noise.floor_e2:.3g} e⁻² per pixel, {ratio:.3g} times that of one read without sky"
    )


def _limit_text(row: CurveRow) -> str:
    """Limiting magnitude as text; with ≥ where the grid ends before the criterion is missed."""
    if not math.isfinite(row.limit_mag):
        return "not reached at any magnitude"
    return f"m_J {'≥ ' if row.at_the_end else ''}{row.limit_mag:.1f}"


# -- noise of the frames of a fainter star: of all reads of an exposure, with sky and dark current ---


def _noises_of(
    ramp: Ramp, mag_j: float, instrument: Instrument, which: Literal["reads", "recorded"]
) -> tuple[NoiseModel, NoiseModel, NoiseRow]:
    """Return the noise that the dimmed frames of a ramp are given, that of one read without sky, and both."""
    recorded = ramp.data.noise
    told = _exposure_noise(ramp, mag_j, instrument) if which == "reads" else None
    faint = recorded if told is None else told.beyond(recorded)
    one_read = recorded if told is None else NoiseModel(1.0, told.read_noise_e**2)
    row = NoiseRow.filled_from(
        *(faint, told),
        exposure_s=ramp.acquisition.exposure_s or math.nan,
        one_read_floor_e2=one_read.floor_e2,
    )
    return faint, one_read, row


def _exposure_noise(ramp: Ramp, mag_j: float, instrument: Instrument) -> ExposureNoise | None:
    """Return the noise of an exposure of a ramp as the instrument reads it; None where that is not known.

    Reads and their noise as declared for the recording, else by the profile; the sky as declared, else by
    its brightness relative to the star's.
    """
    acquisition, defaults = ramp.acquisition, instrument.defaults
    detector, exposure_s = acquisition.detector, acquisition.exposure_s
    read_s = defaults.get("detector.read_s")
    reads = detector.reads
    noise_e: float | None = detector.read_noise_e / reads**0.5
    if reads == 1 and read_s and exposure_s:
        reads, noise_e = max(1, round(exposure_s / read_s)), defaults.get("detector.read_noise_e")
    if exposure_s is None or noise_e is None:
        return None
    dark_e = defaults.get("detector.dark_e_per_s", 0.0) * exposure_s
    sky_e = max(detector.background_e - dark_e, _sky_e_per_s(ramp, mag_j, instrument) * exposure_s)
    factor = max(detector.excess_noise_factor, defaults.get("detector.excess_noise_factor", 1.0))
    return ExposureNoise(reads, noise_e, factor, sky_e, dark_e)


def _sky_e_per_s(ramp: Ramp, mag_j: float, instrument: Instrument) -> float:
    """Light of the sky in a pixel, from that of the star of known magnitude."""
    acquisition = ramp.acquisition
    star_e = max(float(ramp.data.images_e.double().sum((1, 2)).median()), 0.0)
    star_e_per_s_m0 = star_e / (acquisition.exposure_s or math.inf) * 10 ** (0.4 * mag_j)
    return instrument.facility.sky_photons_per_s(
        acquisition.spectrum, star_e_per_s_m0, acquisition.pixel_scale_mas
    )


# -- what a scan will take, said and judged before its work begins -----------------------------------


def announce(
    frames: int,
    window: tuple[int, int],
    realisations: int,
    magnitudes: int,
    curves: int,
    log: logging.Logger,
) -> None:
    """Say how many estimates there will be, as a warning where it takes minutes.

    `window` has rows and columns [px] of the `frames` that are dimmed; `realisations` are draws of the noise
    of every frame. Raises `ConfigurationError` where the memory does not suffice for one magnitude.
    """
    rows, columns = window
    at_once = frames * realisations
    estimates = at_once * magnitudes * curves
    text = (
        f"{estimates} estimates of {rows}x{columns} px: {frames} frames x {realisations} realisations x "
        f"{magnitudes} magnitudes x {curves} curves"
    )
    advice = "lower sensitivity.realisations or sensitivity.frames_per_offset"
    require_memory(BYTES_PER_PIXEL * at_once * rows * columns, text, ConfigurationError, advice)
    log.log(logging.WARNING if estimates > MANY else logging.INFO, "%s", text)
