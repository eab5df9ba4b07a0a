"""Ingest: from the files of the recorder to clean frames in electrons."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.files.limits import require_memory
from irlos_pipe.frames.believed_detector import READ_NOISE, believed
from irlos_pipe.frames.cleaning import Cleaned, clean
from irlos_pipe.frames.recording import PROFILE, Acquisition, Recording
from irlos_pipe.frames.screening import REPEATED_IMAGE, tally
from irlos_pipe.frames.told import told_of
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.times import counter_step, frames_missing, relative_times
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.ingest.accumulate import accumulated
from irlos_pipe.stages.ingest.config import Config
from irlos_pipe.stages.ingest.output import checks, contradictions, dark_row, row, summary, told_check
from irlos_pipe.stages.ingest.recording_arrays import arrays_of
from irlos_pipe.stages.ingest.results import IngestResults, RecordingRow
from irlos_pipe.stages.ingest.sources import (
    Source,
    failing_alone,
    read_sources,
    with_darks,
)

BYTES_PER_PIXEL = 1600  # of the window; cleaning took 6.3 GB for a frame of 2000x2000 px
BYTES_PER_VALUE = 8


def run(ctx: StageContext[Config]) -> StageOutput:
    """Read, calibrate and screen every recording of every input.

    Raises
    ------
    NothingToDo
        An input without recordings.
    InputDataError
        An input of which nothing can be used; the message states the first reason.
    """
    sources, failures = read_sources(ctx.inputs, ctx.config.keys_for, ctx.instrument, ctx.log)
    stars, darks = with_darks(sources)
    arrays: dict[str, Quantity] = {}
    rows: list[RecordingRow] = []
    quality: list[Check] = []
    for source in ctx.progress(stars, desc="ingest"):
        with failing_alone(failures, source.input, source.raw.path, ctx.log):
            source = _accumulated(source, ctx)
            recording, cleaned = ingest(source, ctx.config, ctx.instrument)
            told = told_of(recording, cleaned.noise, ctx.instrument.facility, _step_s(source.raw))
            doubts = [f"{recording.name}: {one.text}" for one in told if one.warned]
            for line in (*contradictions(recording, cleaned), *doubts):
                ctx.log.warning(line)
            rows.append(row(recording, cleaned, source.raw, told, ctx.instrument.name))
            quality += [*checks(recording, ctx.config), told_check(recording, told)]
            arrays |= arrays_of(recording, cleaned, source.raw)
    _require_every_input(ctx.inputs, rows, failures)
    lines = [text for _, text in failures]
    results = IngestResults(inputs=[*rows, *map(dark_row, darks)])
    return StageOutput(arrays, results, quality, summary=summary(rows), failures=lines)


def _accumulated(source: Source, ctx: StageContext[Config]) -> Source:
    """The recording with raw frames summed, where that is wanted."""
    exposure_s = ctx.config.exposure_of(source.input)
    if exposure_s is None:
        return source
    summed = accumulated(source, exposure_s)
    if summed is not source:
        ctx.log.info(summed.raw.notes[-1])
    return summed


def ingest(source: Source, config: Config, instrument: Instrument) -> tuple[Recording, Cleaned]:
    """Clean one recording; a second time where its frames contradict the profile's detector.

    Parameters
    ----------
    source : Source
        The recording as read, and how it was taken.
    config : Config
        Limits for pixels and frames.
    instrument : Instrument
        Gives the diameter of the pupil.

    Raises
    ------
    InputDataError
        None of its frames can be used, all are the same image, or the noise of a single one is not known.
    """
    _require_room(source)
    cleaned = _cleaned(source, config, instrument)
    told = source.resolved.acquisition
    detector, sources = believed(told.detector, told.sources, cleaned.noise)
    if detector != told.detector:
        acquisition = replace(told, detector=detector, sources=sources)
        source = replace(source, resolved=replace(source.resolved, acquisition=acquisition))
        cleaned = _cleaned(source, config, instrument)
    if source.raw.frames == 1:
        _require_noise_level(source, cleaned)
    return _recording(source, cleaned), cleaned


def _require_room(source: Source) -> None:
    frames, rows, columns = source.raw.adu.shape
    needed_bytes = BYTES_PER_PIXEL * rows * columns + BYTES_PER_VALUE * source.raw.adu.size
    where = f"{source.raw.path}: {frames} frames of {rows}x{columns} px"
    require_memory(needed_bytes, where, InputDataError, "cut the window, or the recording into parts")


def _cleaned(source: Source, config: Config, instrument: Instrument) -> Cleaned:
    raw, acquisition = source.raw, source.resolved.acquisition
    sampling = sampling_px(acquisition, instrument)
    cleaned = clean(raw, acquisition.detector, sampling, config.thresholds(), config.limits())
    if not cleaned.used.any():
        counts = ", ".join(f"{number} x {reason}" for reason, number in tally(cleaned.reasons).items())
        raise InputDataError(f"{raw.path}: none of the {raw.frames} frames can be used: {counts}")
    if np.sum(cleaned.reasons == REPEATED_IMAGE) == raw.frames - 1 > 0:
        raise InputDataError(
            f"{raw.path}: all {raw.frames} frames are the same image, which tells nothing of their noise; "
            "give it once, as one frame"
        )
    return cleaned


def _step_s(raw: RawRecording) -> float:
    """Time from frame to frame by the clock of the recorder; NaN without one [s]."""
    if raw.unix_s is None or np.isfinite(raw.unix_s).sum() < 3:
        return float("nan")
    known = np.isfinite(raw.unix_s)
    times_s, counter = raw.unix_s[known], raw.frame_counter[known]
    frames = (counter[-1] - counter[0]) / counter_step(raw.frame_counter)
    step_s = float((times_s[-1] - times_s[0]) / frames) if frames > 0 else 0.0
    return step_s if step_s > 0 else float("nan")  # a clock that stands tells nothing


def _require_noise_level(source: Source, cleaned: Cleaned) -> None:
    told = source.resolved.acquisition.sources.get(READ_NOISE, PROFILE) != PROFILE
    if not told and not cleaned.noise.floor_e2 > 0:
        raise InputDataError(
            f"{source.raw.path}: one frame, and its noise is not told nor can it be measured, for the star "
            "fills the window; add detector.read_noise_e to the side-car (of dark, sky and read-out together)"
        )


def sampling_px(acquisition: Acquisition, instrument: Instrument) -> float:
    """Return the pixels per λ/D at the shortest wavelength of an `acquisition` with an `instrument`.

    D is that of a lenslet in 2x2 modes.
    """
    shortest_nm = min(wavelength for wavelength, weight in acquisition.spectrum if weight > 0)
    diameter_m = instrument.pupil.diameter_m / acquisition.lenslets
    return resolution_px(shortest_nm * NM, diameter_m, acquisition.pixel_scale_mas)


def _recording(source: Source, cleaned: Cleaned) -> Recording:
    raw, acquisition = source.raw, source.resolved.acquisition
    detector = replace(acquisition.detector, saturation_adu=cleaned.saturation_adu)
    return Recording(
        name=raw.name,
        input=source.input,
        images_e=cleaned.images_e,
        used=cleaned.used,
        reason=cleaned.reasons,
        good=cleaned.good,
        time_s=relative_times(raw.unix_s, raw.frame_counter, acquisition.frame_rate_hz),
        frame_counter=raw.frame_counter,
        introduced_defocus_nm=source.resolved.introduced_defocus_nm,
        acquisition=replace(acquisition, detector=detector),
        background_variance_e2=cleaned.background_variance_e2,
        dark_variance_e2=cleaned.dark_variance_e2,
        frames_missing=frames_missing(raw.frame_counter),
        start_unix_s=raw.start_unix_s,
    )


def _require_every_input(
    inputs: Iterable[str], rows: Sequence[RecordingRow], failures: Sequence[tuple[str, str]]
) -> None:
    """Stop if an input has nothing left, with the reasons."""
    for name in inputs:
        if not any(row.input == name for row in rows):
            reasons = [text for owner, text in failures if owner == name]
            raise InputDataError(
                reasons[0] + and_more(reasons) if reasons else f"input '{name}': only darks, no star in it"
            )
