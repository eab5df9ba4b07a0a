"""Ingest: from the files of the recorder to clean frames in electrons."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.conventions.text import and_more
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.blocks import picked
from irlos_pipe.frames.cleaning import Cleaned, clean
from irlos_pipe.frames.dark_noise import dark_variance_e2
from irlos_pipe.frames.raw import RawRecording
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.frames.screening import Limits, tally
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.product import Quantity
from irlos_pipe.readers.find import files_of as recording_parts
from irlos_pipe.readers.find import recording_files
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.readers.times import frames_missing, relative_times
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.ingest.recordings import arrays_from_recording, prefix_of
from irlos_pipe.stages.ingest.report import checks, dark_row, row, summary
from irlos_pipe.stages.ingest.sources import Source, read_sources, with_darks

NAME = "ingest"
VERSION = 3
READS = ()
DEPENDS_ON = frozenset({"instrument", "inputs"})


class Config(StageConfig):
    """Settings of ingest; every threshold has its unit in its name."""

    acquisition: AcquisitionKeys = Field(
        AcquisitionKeys(), description="side-car keys that win over the side-cars"
    )
    acquisition_of: dict[str, AcquisitionKeys] = Field(
        {}, description="the same for single inputs, by input name; wins over `acquisition`"
    )

    bad_pixel_sigma: float = Field(
        8.0, ge=3, le=100, description="deviation from the neighbours over the noise"
    )
    bad_pixel_fraction: float = Field(
        0.1, ge=0.02, le=1, description="the same over the neighbours' brightness"
    )
    stuck_ratio: float = Field(0.3, ge=0, lt=1, description="scatter of a stuck pixel over the read noise")
    noisy_ratio: float = Field(
        5.0, ge=2, le=100, description="scatter of a noisy pixel over the expected one"
    )
    flicker_fraction: float = Field(
        0.05, gt=0, le=1, description="of the frames: a pixel hit more often is bad"
    )

    max_saturated_px: int = Field(0, ge=0, description="saturated pixels tolerated in a frame")
    min_star_snr: float = Field(8.0, ge=3, le=1000, description="peak of the star over the noise")
    min_edge_px: float = Field(2.0, ge=0, le=100, description="distance of the star from the window's edge")
    flux_sigma: float = Field(
        8.0, ge=3, le=100, description="flux outlier: deviation over the robust scatter"
    )
    flux_fraction: float = Field(0.3, gt=0, le=10, description="flux outlier: deviation over the median")
    core_fraction: float = Field(0.1, gt=0, lt=1, description="of the peak: brighter pixels are the core")

    max_rejected_fraction: float = Field(0.2, ge=0, le=1, description="QC limit, of the frames")
    max_saturated_fraction: float = Field(0.05, ge=0, le=1, description="QC limit, of the frames")
    max_missing_fraction: float = Field(0.1, ge=0, le=1, description="QC limit, of the frames")
    max_bad_pixel_fraction: float = Field(0.02, ge=0, le=1, description="QC limit, of the window")
    max_centre_offset_fraction: float = Field(
        0.25, gt=0, le=1, description="QC limit, of the smaller window side"
    )

    def thresholds(self) -> Thresholds:
        """Return the thresholds for single pixels."""
        return Thresholds(
            self.bad_pixel_sigma,
            self.bad_pixel_fraction,
            self.stuck_ratio,
            self.noisy_ratio,
            self.flicker_fraction,
        )

    def limits(self) -> Limits:
        """Return the limits for frames."""
        return Limits(
            self.max_saturated_px,
            self.min_star_snr,
            self.min_edge_px,
            self.flux_sigma,
            self.flux_fraction,
            self.core_fraction,
        )

    def keys_for(self, input_name: str) -> AcquisitionKeys:
        """Return what the recipe says about an input."""
        own = self.acquisition_of.get(input_name, AcquisitionKeys())
        return self.acquisition.updated(own)


def files_of(root: Path) -> list[Path]:
    """Return every file that ingest reads of an input, given as a file or folder `root`."""
    with suppress(NothingToDo):
        return [path for recording in recording_files([root]) for path in recording_parts(recording)]
    return []


def run(ctx: StageContext) -> StageOutput:
    """Read, calibrate and screen every recording of every input.

    Raises
    ------
    NothingToDo
        An input without recordings.
    InputDataError
        An input of which nothing can be used; the first reason is told.
    """
    sources, failures = read_sources(ctx.inputs, ctx.config.keys_for, ctx.instrument, ctx.log)
    stars, darks = with_darks(sources)
    arrays: dict[str, Quantity] = {}
    rows, qc = [], []
    for source in ctx.progress(stars, desc="ingest"):
        try:
            recording, cleaned = ingest(source, ctx.config, ctx.instrument)
        except InputDataError as error:
            failures.append((source.input, str(error)))
            continue
        rows.append(row(recording, cleaned, source.raw))
        qc += checks(recording, ctx.config)
        arrays |= _arrays(recording, cleaned, source.raw)
    _require_every_input(ctx.inputs, rows, failures)
    rows += [dark_row(dark) for dark in darks]
    return StageOutput(
        arrays, {"inputs": rows}, qc, summary=summary(rows), failures=[text for _, text in failures]
    )


def ingest(source: Source, config: Config, instrument: Instrument) -> tuple[Recording, Cleaned]:
    """Clean one recording.

    Raises
    ------
    InputDataError
        None of its frames can be used.
    """
    raw, acquisition = source.raw, source.resolved.acquisition
    cleaned = clean(
        raw, acquisition.detector, sampling_px(acquisition, instrument), config.thresholds(), config.limits()
    )
    if not np.any(cleaned.reasons == ""):
        counts = ", ".join(f"{number} x {reason}" for reason, number in tally(cleaned.reasons).items())
        raise InputDataError(f"{raw.path}: none of the {raw.frames} frames can be used: {counts}")
    return _recording(source, cleaned), cleaned


def sampling_px(acquisition: Acquisition, instrument: Instrument) -> float:
    """Pixels per lambda/D at the shortest wavelength; D is that of a lenslet in 2x2 modes."""
    lenslets = 1 if acquisition.subaperture is None else 2
    wavelength_m = NM * min(wavelength for wavelength, weight in acquisition.spectrum if weight > 0)
    return resolution_px(wavelength_m, instrument.pupil.diameter_m / lenslets, acquisition.pixel_scale_mas)


def _recording(source: Source, cleaned: Cleaned) -> Recording:
    raw, acquisition = source.raw, source.resolved.acquisition
    detector = replace(acquisition.detector, saturation_adu=cleaned.saturation_adu)
    return Recording(
        name=raw.name,
        input=source.input,
        images_e=cleaned.images_e,
        used=cleaned.reasons == "",
        reason=cleaned.reasons,
        pixel_mask=cleaned.pixel_mask,
        time_s=relative_times(raw.unix_s, raw.frame_counter, acquisition.frame_rate_hz),
        frame_counter=raw.frame_counter,
        introduced_defocus_nm=source.resolved.introduced_defocus_nm,
        acquisition=replace(acquisition, detector=detector),
        background_variance_e2=_background_variance(raw, acquisition, cleaned),
        dark_variance_e2=_dark_variance(raw, acquisition, cleaned),
        frames_missing=frames_missing(raw.frame_counter),
        start_unix_s=raw.start_unix_s,
    )


def _background_variance(raw: RawRecording, acquisition: Acquisition, cleaned: Cleaned) -> float:
    """Variance beyond read noise and star: measured, else from the sky."""
    detector = acquisition.detector
    sky = raw.calibration.background_adu
    sky_e = 0.0 if sky is None else max(0.0, float(np.nanmedian(sky)) * detector.e_per_adu)
    measured = cleaned.noise.beyond_e2(detector.read_noise_e**2)
    return max(measured, sky_e * detector.excess_noise_factor)


def _dark_variance(raw: RawRecording, acquisition: Acquisition, cleaned: Cleaned) -> float:
    """Noise of the dark: not more than the dark itself says, nor than the mean of the frames shows.

    Where neither dark nor sky was taken, the detector's own pattern is in the frames and counts instead.
    """
    maps = raw.calibration
    taken = maps.dark_adu is not None or maps.background_adu is not None
    at_most_e2 = maps.dark_variance_adu2 * acquisition.detector.e_per_adu**2 if taken else np.inf
    return dark_variance_e2(picked(cleaned.images_e, cleaned.reasons == ""), cleaned.pixel_mask, at_most_e2)


def _arrays(recording: Recording, cleaned: Cleaned, raw: RawRecording) -> dict[str, Quantity]:
    prefix = prefix_of(recording)
    hits = np.stack([cleaned.hits.frame, cleaned.hits.row, cleaned.hits.column], axis=1)
    return arrays_from_recording(recording, prefix) | {
        f"{prefix}/raw_adu": Quantity(raw.adu, "ADU", "counts as recorded (frame, y, x)"),
        f"{prefix}/background_adu": Quantity(
            cleaned.background.adu, "ADU", "subtracted from the counts (y, x)"
        ),
        f"{prefix}/flat": Quantity(cleaned.background.flat, "", "relative response, divided out (y, x)"),
        f"{prefix}/cosmic_hits": Quantity(hits, "", "replaced pixels: frame, row, column"),
    }


def _require_every_input(inputs: dict, rows: list[dict], failures: list[tuple[str, str]]) -> None:
    """Stop if an input has nothing left, telling why."""
    for name in inputs:
        if not any(row["input"] == name for row in rows):
            reasons = [text for owner, text in failures if owner == name]
            raise InputDataError(
                reasons[0] + and_more(reasons) if reasons else f"input '{name}': only darks, no star in it"
            )
