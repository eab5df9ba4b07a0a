"""Stage `correct`: the modal offsets for SPARTA, and what they would do to the image."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import HIGHEST_NOLL, HIGHEST_REPORTED_NOLL, TIP_TILT
from irlos_pipe.estimate.calibration_options import StrehlPart
from irlos_pipe.files.regular import first_image, open_regular
from irlos_pipe.frames.recording import PROFILE, Recording
from irlos_pipe.optics.image_quality import CURVES, quality_curves
from irlos_pipe.optics.wavefront import MapSize, clear_pupil, opd_maps_nm
from irlos_pipe.product.product import Check, Product, declared
from irlos_pipe.product.results import DITTO, ByNoll, Number, ResultsPart, StageResults, item, results_of
from irlos_pipe.product.table import Card, Column, Table
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput, refused
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import recordings_from_product
from irlos_pipe.stages.model.groups import turned_angles

if TYPE_CHECKING:
    from irlos_pipe.estimate.correction import MirrorOffsets, Offsets, Prediction

VERSION = 7
NEEDS = ("ingest", "calibrate")
MAP_SAMPLES = 160  # across the pupil in maps
MIRROR_SIGN = (
    "offset: add it to the reference of the mode to cancel the aberration; in the unit of the table of "
    "modes, whose maps are OPD in nm; diversity, piston, tip and tilt not included"
)
LEAST_SAMPLES, MOST_SAMPLES, MOST_MODES = 16, 512, 2000  # of a table of mirror modes


def offset_text(gain: float) -> str:
    """Return what an offset is."""
    return "offset = -NCPA" if gain == 1 else f"offset = -{gain:g} NCPA"


def sign_text(gain: float) -> str:
    """Return what the sign of the offsets means."""
    aim = "to cancel" if gain == 1 else f"to cancel {gain:.0%} of"
    return (
        f"{offset_text(gain)}: add the offset to the reference {aim} the aberration; OPD in nm RMS, Noll; "
        "diversity not included"
    )


ARRAYS = {
    "noll": ("", "mode", "Noll index"),
    "offset_nm": (
        "nm ±",
        "mode",
        "to be added to the reference: -gain × NCPA; diversity not included",
    ),
    "wavefront_before_nm": ("nm", "y, x", "estimated wavefront without tip and tilt"),
    "wavefront_after_nm": ("nm", "y, x", "what the offsets leave of it"),
    "before": ("", "y, x", "unit-flux image without correction"),
    "after": ("", "y, x", "unit-flux image with the offsets applied"),
    "perfect": ("", "y, x", "unit-flux image without aberration"),
    "radius_mas": ("mas", "ring", "radius of the rings"),
    "profile_before": ("", "ring", "mean of each ring, without correction"),
    "profile_after": ("", "ring", "mean of each ring, with the offsets applied"),
    **CURVES,
} | {"mirror_offset": ("±", "mode", MIRROR_SIGN)}
CHECKS = {"predicted Strehl": ("predicted Strehl against the best that the AO residual leaves", "")}


class MirrorFile(BaseModel):
    """A file with modes, by its content: other modes in the same file are another correction."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    file: str = Field(description="path of the FITS cube")
    sha256: str = Field(description="checksum of its content, filled in when the recipe is read")


def mirror_file(value: Any) -> Any:
    """Return path and checksum for the path of a file; for both of before, those of the file as it is now.

    Raises `ValueError` where the file cannot be read.
    """
    named = value.get("file") if isinstance(value, dict) else value
    if not isinstance(named, str):
        return value
    path = Path(named).absolute()
    try:
        with open_regular(path) as stream:
            return {"file": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}
    except OSError as error:
        raise ValueError(f"{named}: {error.strerror or error}; give a FITS cube of OPD maps [nm]") from None


class Config(StageConfig):
    """Settings of the correction."""

    input: str = item("calibration", "recipe input whose configuration the prediction uses")
    gain: float = item(1.0, "part of the measured aberration to correct", gt=0, le=1)
    highest_noll: int = item(HIGHEST_REPORTED_NOLL, "highest Noll mode of the offsets", ge=4, le=HIGHEST_NOLL)
    mirror_modes: Annotated[MirrorFile | None, BeforeValidator(mirror_file)] = item(
        None, "FITS cube of a mirror's modes, n × n OPD maps across the pupil [nm per unit]"
    )


class MirrorRow(ResultsPart):
    """The correction in the modes of a mirror, see `estimate.correction.MirrorOffsets`."""

    modes: int = item(0, "Number of modes of its table.")
    offset: list[Number] = item([], "Offset of each, in the unit of the table.")
    before_nm: Number = item(
        nan,
        "RMS over the clear pupil without piston, tip and tilt: of the estimated wavefront, and of what the "
        "modes cannot make of it [nm].",
    )
    after_nm: Number = item(nan, DITTO)


class CorrectResults(StageResults):
    """Offsets to add to the reference [nm RMS], and the Strehl ratio predicted without and with them."""

    stage: ClassVar[str] = "correct"
    offset_nm: ByNoll = item(
        {}, "Modal offsets to add to the reference, by Noll index [nm RMS]: −NCPA, without the diversity."
    )
    sign: str = item("", "What the sign of the offsets means, in words.")
    strehl_before: Number = item(nan, "Strehl ratio predicted without and with the offsets.")
    strehl_after: Number = item(nan, DITTO)
    strehl_measured: Number = item(
        nan,
        "Strehl ratio of the mean image, its diversity included: brightest pixel over the sum of the window, "
        "divided by the same of the image without aberrations.",
    )
    strehl_budget: list[StrehlPart] = item(
        [], "What each part of the model costs the image before the correction; the whole model first."
    )
    wavefront_before: MapSize = item(
        MapSize(), "RMS and peak to valley of the maps of the wavefront, without tip and tilt."
    )
    wavefront_after: MapSize = item(MapSize(), DITTO)
    resolution_mas: Number = item(nan, "λ/D at the mean wavelength.")
    mirror: MirrorRow | None = item(
        None, "The same correction in the modes of a mirror, where their table was given."
    )


Results = CorrectResults


def angles_text(angles_deg: Sequence[float]) -> str:
    """Return what is said of offsets from recordings at several angles of the derotator; else nothing."""
    there = turned_angles(angles_deg, angles_deg[0])
    return there and (
        f"the offsets are those of a mean over {there} of the derotator, and of the NCPAs the part before it "
        "turns: they are right at no angle; give recordings of one angle, or run the recipe derotator"
    )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Write the offsets as CSV and FITS, and predict the image before and after the correction."""
    from irlos_pipe.estimate.correction import modal_offsets

    arrays = ctx.products["calibrate"].arrays
    nolls = [int(n) for n in arrays["noll"].value]
    zernike, sigma = np.array(arrays["zernike_nm"].value, float), np.array(arrays["zernike_nm"].error, float)
    offsets = modal_offsets(nolls, zernike, sigma, ctx.config.gain, ctx.config.highest_noll)
    recordings = recordings_from_product(ctx.products["ingest"], ctx.config.input)
    if several := angles_text([one.acquisition.derotator_angle_deg for one in recordings]):
        ctx.log.warning(several)
    recording = recordings[0]
    prediction, budget = _predict(ctx, recording, nolls, zernike)
    table = _table(ctx, offsets, prediction)
    seen = np.where(np.isin(nolls, TIP_TILT), 0.0, zernike)
    left = np.where(np.array(nolls) <= ctx.config.highest_noll, (1 - ctx.config.gain) * seen, seen)
    lit = clear_pupil(ctx.instrument.pupil, MAP_SAMPLES)
    before_nm, after_nm = opd_maps_nm(nolls, seen, lit), opd_maps_nm(nolls, left, lit)
    scale_mas = recording.acquisition.pixel_scale_mas or math.nan
    checks = _checks(ctx, recording, prediction)
    before = checks_behind(ctx.products.values(), ctx.config.input)
    output = StageOutput(
        declared(
            ARRAYS,
            {"wavefront_before_nm": before_nm, "wavefront_after_nm": after_nm}
            | _arrays(offsets, prediction, scale_mas),
        ),
        CorrectResults.filled_from(
            prediction,
            offset_nm=dict(zip(offsets.nolls.tolist(), offsets.value_nm.tolist(), strict=True)),
            sign=sign_text(ctx.config.gain),
            strehl_budget=budget,
            wavefront_before=MapSize.of(before_nm),
            wavefront_after=MapSize.of(after_nm),
            resolution_mas=prediction.resolution_px * scale_mas,
            strehl_measured=_sharpness(arrays["mean_image_e"].value) / _sharpness(prediction.perfect)
            if "mean_image_e" in arrays
            else math.nan,
        ),
        checks,
        files={"correction.csv": table, "correction.fits": table},
        summary=[
            f"Correction      {_advice(prediction, [*checks, *before])}, {len(offsets.nolls)} offsets in "
            "correction.csv and correction.fits"
        ],
    )
    return output if ctx.config.mirror_modes is None else in_mirror_modes(ctx, output)


def checks_behind(products: Iterable[Product], used: str) -> list[Check]:
    """Return the checks of a correction by its `products`; of ingest those of the recipe input `used`."""
    checks = [
        (one.stage, check)
        for one in products
        if one.stage in (*NEEDS, CorrectResults.stage)
        for check in one.checks
    ]
    return [one for stage, one in checks if stage != "ingest" or one.name.startswith(f"ingest/{used}/")]


def _advice(prediction: Prediction, checks: list[Check]) -> str:
    """The predicted gain, or why there is none to count on."""
    if not all(check.passed for check in checks):
        return "DO NOT APPLY: a check failed"
    before, after = prediction.strehl_before, prediction.strehl_after
    if not after > before:
        return f"no gain predicted (Strehl {before:.3f} → {after:.3f})"
    return f"Strehl {before:.3f} → {after:.3f} predicted"


def _sharpness(image: np.ndarray) -> float:
    """Brightest pixel over the sum of an `image`."""
    return float(image.max() / image.sum())


def _table(ctx: StageContext[Config], offsets: Offsets, prediction: Prediction) -> Table:
    """The offsets as they are handed on, with what they mean and how good they are."""
    calibration = results_of(CalibrateResults, ctx.products["calibrate"])
    columns = (
        Column("noll", "", offsets.nolls, "Noll index"),
        Column("offset_nm", "nm", offsets.value_nm, "to be added to the reference", ".4f"),
        Column("sigma_nm", "nm", offsets.sigma_nm, "1-sigma error", ".4f"),
    )
    facts = (
        Card("IRLOS SIGN", offset_text(ctx.config.gain), "add it to the reference"),
        Card("IRLOS BASIS", "Zernike, Noll", "indices and order"),
        Card("IRLOS NORM", "unit RMS over the unobscured disc"),
        Card("IRLOS PUPIL DIAMETER", float(ctx.instrument.pupil.diameter_m), "[m] of the disc"),
        Card("IRLOS GAIN", ctx.config.gain, "part of the aberration corrected"),
        Card("ESO QC NCPA RMS", calibration.wfe_nm, "[nm] NCPAs, Noll 2-30"),
        Card("ESO QC NCPA RMS SIGMA", calibration.wfe_sigma_nm, "[nm]"),
        Card("ESO QC NCPA HIGHER", calibration.higher_nm, "[nm] NCPAs, Noll 4-30"),
        Card("ESO QC NCPA HIGHER SIGMA", calibration.higher_sigma_nm, "[nm]"),
        Card("ESO QC CHI2 NU", calibration.chi2_nu, "of the mean image"),
        Card("ESO QC STREHL BEFORE", prediction.strehl_before, "predicted"),
        Card("ESO QC STREHL AFTER", prediction.strehl_after, "predicted with the offsets"),
    )
    return Table("MODAL_OFFSETS", "IRLOS_MODAL_OFFSETS", columns, sign_text(ctx.config.gain), facts)


def _checks(ctx: StageContext[Config], recording: Recording, prediction: Prediction) -> list[Check]:
    """A Strehl ratio predicted without the AO residual may not exceed what the residual alone leaves.

    Only where the seeing of the recording is declared, and the calibration has not measured the residual.
    """
    from irlos_pipe.effects import SeeingHalo

    acquisition = recording.acquisition
    told = acquisition.sources.get("seeing_arcsec", PROFILE) != PROFILE
    if not told or SeeingHalo.name in results_of(CalibrateResults, ctx.products["calibrate"]).effects:
        return []
    seeing, law = acquisition.seeing_arcsec or math.nan, ctx.instrument.facility.residual_law
    wavelengths_nm, weights = np.array(acquisition.spectrum).T
    wavelength_nm = float(wavelengths_nm @ weights / weights.sum())
    limit = float(np.exp(-((2 * np.pi * law.wfe_nm(seeing) / wavelength_nm) ** 2)))
    message = (
        f"Strehl {prediction.strehl_after:.3f} is predicted without the AO residual, which leaves at best "
        f"{limit:.3f} ({seeing:.2f} arcsec): put seeing_halo into the model"
    )
    return [Check("predicted Strehl", prediction.strehl_after, "", None, limit, message)]


def _predict(
    ctx: StageContext[Config], recording: Recording, nolls: list[int], zernike_nm: np.ndarray
) -> tuple[Prediction, list[StrehlPart]]:
    """Images before and after the correction, and what every part of the model takes of the Strehl ratio."""
    from irlos_pipe.estimate.correction import predict_correction, strehl_budget
    from irlos_pipe.stages.model.effects import calibrated_effects, psf_settings, seeing_arcsec

    product = ctx.products["calibrate"]
    seeing = seeing_arcsec(ctx.instrument, recording.acquisition)
    effects = calibrated_effects(product, ctx.instrument, ctx.model, recording, seeing, same_star=True)
    settings = psf_settings(ctx.instrument, ctx.model, recording)
    fitted_nm = np.array(product.arrays["modes_nm"].value, float)
    highest_noll = ctx.config.highest_noll
    corrected = np.array(nolls) <= highest_noll
    gain, in_model = np.where(corrected, ctx.config.gain, 0.0), list(effects.values())
    prediction = predict_correction(settings, nolls, fitted_nm, zernike_nm, gain, in_model)
    parts = {f"Noll 4–{highest_noll}": np.where(corrected, prediction.modes_before_nm, 0.0)}
    beyond = {f"Noll {highest_noll + 1}–{nolls[-1]}": np.where(corrected, 0.0, prediction.modes_before_nm)}
    parts |= {} if corrected.all() else beyond
    return prediction, strehl_budget(settings, nolls, parts, effects)


def _arrays(offsets: Offsets, prediction: Prediction, pixel_scale_mas: float) -> dict[str, Any]:
    """Offsets, predicted images, their profiles, encircled energy and OTF about the optical axis."""
    images = {name: getattr(prediction, name) for name in ("before", "after", "perfect")}
    profiles = {name: getattr(prediction, name) for name in ("radius_mas", "profile_before", "profile_after")}
    modes = {"noll": offsets.nolls, "offset_nm": (offsets.value_nm, offsets.sigma_nm)}
    axis = tuple((size - 1) / 2 for size in prediction.before.shape)
    curves = quality_curves(images, axis, prediction.resolution_px, pixel_scale_mas)
    return images | profiles | modes | curves


# -- the correction in the modes of a mirror ---------------------------------------------------------


def in_mirror_modes(ctx: StageContext, output: StageOutput) -> StageOutput:
    """Return the `output` of the stage with the offsets of a mirror's modes: arrays, results and files.

    Raises `InputDataError` if the table of modes that the settings of `ctx` name cannot be used.
    """
    from irlos_pipe.estimate.correction import mirror_offsets

    named: MirrorFile = ctx.config.mirror_modes
    path = Path(named.file)
    maps_nm = _read_modes(path)
    arrays = ctx.products["calibrate"].arrays
    nolls, zernike_nm, covariance_nm2 = (
        np.asarray(arrays[name].value) for name in ("noll", "zernike_nm", "covariance_nm2")
    )
    lit = clear_pupil(ctx.instrument.pupil, maps_nm.shape[-1])
    with refused(InputDataError, str(path)):
        found = mirror_offsets(maps_nm, nolls.tolist(), zernike_nm, covariance_nm2, lit, ctx.config.gain)
    table = _mirror_table(named, ctx.config.gain, found)
    row = MirrorRow.filled_from(found, modes=len(found.value), offset=found.value.tolist())
    line = (
        f"  {len(found.value)} modes of {path.name}: {found.before_nm:.1f} nm RMS, of which they cannot make "
        f"{found.after_nm:.1f}; offsets in mirror.csv and mirror.fits"
    )
    return replace(
        output,
        arrays=output.arrays | declared(ARRAYS, {"mirror_offset": (found.value, found.sigma)}),
        results=output.results.model_copy(update={"mirror": row}),
        files=output.files | {"mirror.csv": table, "mirror.fits": table},
        summary=[*output.summary, line],
    )


def _mirror_table(named: MirrorFile, gain: float, found: MirrorOffsets) -> Table:
    columns = (
        Column("mode", "", np.arange(len(found.value)), "index in the table, from 0"),
        Column("offset", "", found.value, "to be added to the reference", ".6g"),
        Column("sigma", "", found.sigma, "1-sigma error", ".3g"),
    )
    facts = (
        Card("IRLOS SIGN", "offset cancels NCPA", "add it to the reference"),
        Card("IRLOS BASIS", Path(named.file).name, "table of modes"),
        Card("IRLOS BASIS SHA256", named.sha256[:32], "first 32 digits"),
        Card("IRLOS GAIN", gain, "part of the aberration corrected"),
        Card("ESO QC MIRROR BEFORE", found.before_nm, "[nm] RMS over the clear pupil"),
        Card("ESO QC MIRROR AFTER", found.after_nm, "[nm] RMS that the modes cannot make"),
    )
    return Table("MIRROR_OFFSETS", "IRLOS_MIRROR_OFFSETS", columns, MIRROR_SIGN, facts)


def _read_modes(path: Path) -> np.ndarray:
    """Return OPD maps of a mirror's modes, (modes, n, n), from the first image of a FITS file.

    n samples lie across the diameter of the pupil, as pixels across a window; row index is y.
    """
    with refused(InputDataError, str(path), "; modes are a cube of n × n maps across the pupil"):
        maps, _ = first_image(path)
        if maps.ndim != 3 or maps.shape[1] != maps.shape[2]:
            raise ValueError(f"an image of {' × '.join(map(str, maps.shape))}")
    count, samples = maps.shape[:2]
    if not (LEAST_SAMPLES <= samples <= MOST_SAMPLES and 1 <= count <= MOST_MODES):
        raise InputDataError(
            f"{path}: {count} modes of {samples} × {samples}; up to {MOST_MODES} modes of {LEAST_SAMPLES} "
            f"to {MOST_SAMPLES} samples across can be used"
        )
    return maps
