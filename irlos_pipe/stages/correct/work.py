"""Stage `correct`: the modal offsets for SPARTA, and what they would do to the image."""

from __future__ import annotations

import math

import numpy as np

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.effects import SeeingHalo, fixed_optics
from irlos_pipe.estimate.correction import Prediction, predict_correction
from irlos_pipe.frames.recording import PROFILE, Recording
from irlos_pipe.optics.wavefront import clear_pupil, opd_maps_nm
from irlos_pipe.product.header import Card
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.product.results import results_of
from irlos_pipe.product.table import Column, Table
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.correct.config import Config
from irlos_pipe.stages.correct.results import CorrectResults
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.effects import calibrated_effects
from irlos_pipe.stages.model.recording_settings import psf_settings, seeing_arcsec

MAP_SAMPLES = 160
SIGN = (
    "offset = -NCPA: add the offset to the reference to cancel the aberration; OPD in nm RMS, Noll; "
    "diversity not included"
)
Offsets = tuple[np.ndarray, np.ndarray, np.ndarray]  # Noll indices, offsets [nm], standard errors [nm]


def run(ctx: StageContext[Config]) -> StageOutput:
    """Write the offsets as CSV and FITS, and predict the image before and after the correction."""
    arrays = ctx.products["calibrate"].arrays
    nolls = [int(n) for n in arrays["noll"].value]
    zernike, sigma = np.array(arrays["zernike_nm"].value, float), np.array(arrays["zernike_nm"].error, float)
    offsets = _offsets(nolls, -ctx.config.gain * zernike, sigma)
    recording = recordings_from_product(ctx.products["ingest"], ctx.config.input)[0]
    prediction = _predict(ctx, recording, nolls, zernike)
    table = _table(ctx, offsets, prediction)
    return StageOutput(
        _arrays(ctx, nolls, zernike, offsets, prediction),
        _results(offsets, prediction),
        _checks(ctx, recording, prediction),
        files={"correction.csv": table, "correction.fits": table},
        summary=[
            f"Correction      Strehl {prediction.strehl_before:.3f} → {prediction.strehl_after:.3f} "
            f"predicted, {len(offsets[0])} offsets in correction.csv and correction.fits"
        ],
    )


def _offsets(nolls: list[int], offset_nm: np.ndarray, sigma_nm: np.ndarray) -> Offsets:
    """The reported modes; those that were not estimated are 0 with an infinite error."""
    table = {noll: (o, s) for noll, o, s in zip(nolls, offset_nm, sigma_nm, strict=True)}
    values = np.array([table.get(noll, (0.0, np.inf)) for noll in REPORTED_NOLLS])
    return np.array(REPORTED_NOLLS), values[:, 0], values[:, 1]


def _table(ctx: StageContext[Config], offsets: Offsets, prediction: Prediction) -> Table:
    """The offsets as they are handed on, with what they mean and how good they are."""
    calibration = results_of(CalibrateResults, ctx.products["calibrate"])
    columns = (
        Column("noll", "", offsets[0], "Noll index"),
        Column("offset_nm", "nm", offsets[1], "to be added to the reference", ".4f"),
        Column("sigma_nm", "nm", offsets[2], "1-sigma error", ".4f"),
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
) -> Prediction:
    product = ctx.products["calibrate"]
    seeing = seeing_arcsec(ctx.instrument, recording.acquisition)
    effects = calibrated_effects(product, ctx.instrument, ctx.model, recording, seeing, same_star=True)
    return predict_correction(
        psf_settings(ctx.instrument, ctx.model, recording),
        nolls,
        np.array(product.arrays["modes_nm"].value, float),
        zernike_nm,
        np.where(np.array(nolls) <= HIGHEST_REPORTED_NOLL, ctx.config.gain, 0.0),
        lambda model: fixed_optics(list(effects.values()), model.grids),
    )


def _arrays(
    ctx: StageContext[Config],
    nolls: list[int],
    zernike_nm: np.ndarray,
    offsets: Offsets,
    prediction: Prediction,
) -> dict[str, Quantity]:
    seen = np.where(np.isin(nolls, TIP_TILT), 0.0, zernike_nm)
    left = np.where(np.isin(nolls, offsets[0]), (1 - ctx.config.gain) * seen, seen)
    lit = clear_pupil(ctx.instrument.pupil, MAP_SAMPLES)
    before_nm, after_nm = (opd_maps_nm(nolls, modes_nm, lit) for modes_nm in (seen, left))
    arrays = {
        name: Quantity(getattr(prediction, name), "", f"unit-flux image, {text}")
        for name, text in (
            ("before", "without correction"),
            ("after", "with the offsets applied"),
            ("perfect", "no aberration"),
        )
    }
    return arrays | {
        "noll": Quantity(offsets[0], "", "Noll index"),
        "offset_nm": Quantity(offsets[1], "nm", SIGN, offsets[2]),
        "radius_mas": Quantity(prediction.radius_mas, "mas", "radius of the rings"),
        "profile_before": Quantity(prediction.profile_before, "", "mean of each ring, unit-flux image"),
        "profile_after": Quantity(prediction.profile_after, "", "mean of each ring, unit-flux image"),
        "wavefront_before_nm": Quantity(before_nm, "nm", "estimated wavefront without tip and tilt"),
        "wavefront_after_nm": Quantity(after_nm, "nm", "what the offsets leave of it"),
    }


def _results(offsets: Offsets, prediction: Prediction) -> CorrectResults:
    return CorrectResults(
        offset_nm=dict(zip(offsets[0].tolist(), offsets[1].tolist(), strict=True)),
        sign=SIGN,
        strehl_before=prediction.strehl_before,
        strehl_after=prediction.strehl_after,
    )
