"""Stage `correct`: the modal offsets for SPARTA, and what they would do to the image."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.effects import SeeingHalo, fixed_optics
from irlos_pipe.estimate.correction import (
    Offsets,
    Prediction,
    modal_offsets,
    predict_correction,
    seen_and_left_nm,
)
from irlos_pipe.estimate.strehl_budget import StrehlPart, strehl_budget
from irlos_pipe.frames.recording import PROFILE, Recording
from irlos_pipe.optics.wavefront import clear_pupil, opd_maps_nm, rms_and_pv
from irlos_pipe.product.header import Card
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.product.results import results_of
from irlos_pipe.product.table import Column, Table
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.correct.config import Config
from irlos_pipe.stages.correct.mirror import in_mirror_modes
from irlos_pipe.stages.correct.results import CorrectResults, MapRow, StrehlRow
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.effects import calibrated_effects
from irlos_pipe.stages.model.recording_settings import psf_settings, seeing_arcsec

MAP_SAMPLES = 160
SIGN = (
    "offset = -NCPA: add the offset to the reference to cancel the aberration; OPD in nm RMS, Noll; "
    "diversity not included"
)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Write the offsets as CSV and FITS, and predict the image before and after the correction."""
    arrays = ctx.products["calibrate"].arrays
    nolls = [int(n) for n in arrays["noll"].value]
    zernike, sigma = np.array(arrays["zernike_nm"].value, float), np.array(arrays["zernike_nm"].error, float)
    offsets = modal_offsets(nolls, zernike, sigma, ctx.config.gain)
    recording = recordings_from_product(ctx.products["ingest"], ctx.config.input)[0]
    prediction, budget = _predict(ctx, recording, nolls, zernike)
    table = _table(ctx, offsets, prediction)
    maps = _maps(ctx, nolls, zernike)
    scale_mas = recording.acquisition.pixel_scale_mas or math.nan
    output = StageOutput(
        maps | _arrays(offsets, prediction) | quality_arrays(prediction, scale_mas),
        _results(offsets, prediction, budget, maps, scale_mas),
        _checks(ctx, recording, prediction),
        files={"correction.csv": table, "correction.fits": table},
        summary=[
            f"Correction      Strehl {prediction.strehl_before:.3f} → {prediction.strehl_after:.3f} "
            f"predicted, {len(offsets.nolls)} offsets in correction.csv and correction.fits"
        ],
    )
    return output if ctx.config.mirror_modes is None else in_mirror_modes(ctx, output)


def _table(ctx: StageContext[Config], offsets: Offsets, prediction: Prediction) -> Table:
    """The offsets as they are handed on, with what they mean and how good they are."""
    calibration = results_of(CalibrateResults, ctx.products["calibrate"])
    columns = (
        Column("noll", "", offsets.nolls, "Noll index"),
        Column("offset_nm", "nm", offsets.value_nm, "to be added to the reference", ".4f"),
        Column("sigma_nm", "nm", offsets.sigma_nm, "1-sigma error", ".4f"),
    )
    facts = (
        Card("IRLOS SIGN", "offset = -NCPA", "add it to the reference"),
        Card("IRLOS BASIS", "Zernike, Noll", "indices and order"),
        Card("IRLOS NORM", "unit RMS over the unobscured disc"),
        Card("IRLOS PUPIL DIAMETER", float(ctx.instrument.pupil.diameter_m), "[m] of the disc"),
        Card("IRLOS GAIN", ctx.config.gain, "part of the aberration corrected"),
        Card("ESO QC NCPA RMS", calibration.wfe_nm, "[nm] NCPAs, Noll 2-30"),
        Card("ESO QC NCPA RMS SIGMA", calibration.wfe_sigma_nm, "[nm]"),
        Card("ESO QC CHI2 NU", calibration.chi2_nu, "of the mean image"),
        Card("ESO QC STREHL BEFORE", prediction.strehl_before, "predicted"),
        Card("ESO QC STREHL AFTER", prediction.strehl_after, "predicted with the offsets"),
    )
    return Table("MODAL_OFFSETS", "IRLOS_MODAL_OFFSETS", columns, SIGN, facts)


def _checks(ctx: StageContext[Config], recording: Recording, prediction: Prediction) -> list[Check]:
    """A Strehl ratio predicted without the AO residual may not exceed what the residual alone leaves.

    Only where the seeing of the recording is told, and the calibration has not measured the residual.
    """
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
    product = ctx.products["calibrate"]
    seeing = seeing_arcsec(ctx.instrument, recording.acquisition)
    effects = calibrated_effects(product, ctx.instrument, ctx.model, recording, seeing, same_star=True)
    settings = psf_settings(ctx.instrument, ctx.model, recording)
    fitted_nm = np.array(product.arrays["modes_nm"].value, float)
    gain = np.where(np.array(nolls) <= HIGHEST_REPORTED_NOLL, ctx.config.gain, 0.0)
    prediction = predict_correction(
        settings,
        nolls,
        fitted_nm,
        zernike_nm,
        gain,
        lambda model: fixed_optics(list(effects.values()), model.grids),
    )
    now_nm, _ = seen_and_left_nm(nolls, fitted_nm, zernike_nm, gain)
    return prediction, strehl_budget(settings, nolls, _parts(nolls, now_nm), effects)


def _parts(nolls: list[int], modes_nm: np.ndarray) -> dict[str, np.ndarray]:
    """The modes that are corrected, and those beyond, where there are any."""
    first = np.array(nolls) <= HIGHEST_REPORTED_NOLL
    parts = {f"Noll 4–{HIGHEST_REPORTED_NOLL}": np.where(first, modes_nm, 0.0)}
    beyond = {f"Noll {HIGHEST_REPORTED_NOLL + 1}–{nolls[-1]}": np.where(first, 0.0, modes_nm)}
    return parts | ({} if first.all() else beyond)


def _maps(ctx: StageContext[Config], nolls: list[int], zernike_nm: np.ndarray) -> dict[str, Quantity]:
    """Maps of the wavefront before and after the correction, without tip and tilt."""
    seen = np.where(np.isin(nolls, TIP_TILT), 0.0, zernike_nm)
    left = np.where(np.isin(nolls, REPORTED_NOLLS), (1 - ctx.config.gain) * seen, seen)
    lit = clear_pupil(ctx.instrument.pupil, MAP_SAMPLES)
    before_nm, after_nm = (opd_maps_nm(nolls, modes_nm, lit) for modes_nm in (seen, left))
    return {
        "wavefront_before_nm": Quantity(before_nm, "nm", "estimated wavefront without tip and tilt"),
        "wavefront_after_nm": Quantity(after_nm, "nm", "what the offsets leave of it"),
    }


def quality_arrays(prediction: Prediction, pixel_scale_mas: float) -> dict[str, Quantity]:
    """Return encircled energy and cuts through the OTF of the predicted images.

    Parameters
    ----------
    prediction : Prediction
    pixel_scale_mas : float
    """
    arrays = {}
    for name in ("before", "after", "perfect"):
        image = getattr(prediction, name)
        energy = prediction.encircled(image)
        arrays["encircled_radius_mas"] = Quantity(energy.at * pixel_scale_mas, "mas", "radius of the circles")
        arrays[f"encircled_{name}"] = Quantity(energy.value, "", "part of the light within a circle")
        for axis, letter in ((1, "x"), (0, "y")):
            cut = prediction.transfer(image, axis)
            arrays[f"otf_{letter}_frequency"] = Quantity(cut.at, "D/λ", f"spatial frequency along {letter}")
            arrays[f"otf_{letter}_{name}"] = Quantity(cut.value, "", f"modulus of the OTF along {letter}")
    return arrays


def _arrays(offsets: Offsets, prediction: Prediction) -> dict[str, Quantity]:
    arrays = {
        name: Quantity(getattr(prediction, name), "", f"unit-flux image, {text}")
        for name, text in (
            ("before", "without correction"),
            ("after", "with the offsets applied"),
            ("perfect", "no aberration"),
        )
    }
    return arrays | {
        "noll": Quantity(offsets.nolls, "", "Noll index"),
        "offset_nm": Quantity(offsets.value_nm, "nm", SIGN, offsets.sigma_nm),
        "radius_mas": Quantity(prediction.radius_mas, "mas", "radius of the rings"),
        "profile_before": Quantity(prediction.profile_before, "", "mean of each ring, unit-flux image"),
        "profile_after": Quantity(prediction.profile_after, "", "mean of each ring, unit-flux image"),
    }


def _map_row(map_nm: np.ndarray) -> MapRow:
    rms_nm, pv_nm = rms_and_pv(map_nm)
    return MapRow(rms_nm=rms_nm, pv_nm=pv_nm)


def _results(
    offsets: Offsets,
    prediction: Prediction,
    budget: Sequence[StrehlPart],
    maps: dict[str, Quantity],
    pixel_scale_mas: float,
) -> CorrectResults:
    return CorrectResults(
        offset_nm=dict(zip(offsets.nolls.tolist(), offsets.value_nm.tolist(), strict=True)),
        sign=SIGN,
        strehl_before=prediction.strehl_before,
        strehl_after=prediction.strehl_after,
        strehl_budget=[
            StrehlRow(name=one.name, wfe_nm=one.wfe_nm, alone=one.alone, without=one.without)
            for one in budget
        ],
        wavefront_before=_map_row(maps["wavefront_before_nm"].value),
        wavefront_after=_map_row(maps["wavefront_after_nm"].value),
        resolution_mas=prediction.resolution_px * pixel_scale_mas,
    )
