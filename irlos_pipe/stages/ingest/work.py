"""Ingest: from the files of the recorder to clean frames in electrons, and what is reported of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.optimize  # noqa: F401  once, not in every process that cleans

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.files.processes import available_bytes, forked_map, require_memory
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.cleaning import Cleaned, clean, time_is_last
from irlos_pipe.frames.recording import (
    PROFILE,
    Recording,
    frame_flux,
    frame_series,
    mean_frame,
    picked,
    star_position,
)
from irlos_pipe.frames.screening import REPEATED_IMAGE, SATURATED, Limits, tally
from irlos_pipe.frames.told import READ_NOISE, Told, believed, constants, of_counts, told_of
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.product import Check, Quantity, declared
from irlos_pipe.product.results import Observed
from irlos_pipe.readers.acquisition import RawRecording, Resolved
from irlos_pipe.readers.times import counter_step, frames_missing, iso_time, relative_times
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.ingest.sources import (
    accumulated,
    as_declared,
    failing_alone,
    read_sources,
    with_darks,
)
from irlos_pipe.stages.ingest.stage import (
    RECORDING,
    Config,
    IngestResults,
    RecordingRow,
    arrays_from_recording,
    prefix_of,
)

BYTES_PER_PIXEL = 1600  # memory for a pixel of the window; cleaning took 6.3 GB for a frame of 2000x2000 px
BYTES_PER_VALUE = 8  # memory for a pixel of every frame


def run(ctx: StageContext[Config]) -> StageOutput:
    """Read, calibrate and screen every recording of every input.

    Raises `NothingToDo` for an input without recordings, and `InputDataError` for one of which nothing can be
    used; the message states the first reason.
    """
    sources, failures = read_sources(ctx.inputs, ctx.config.keys_for, ctx.instrument, ctx.log)
    stars, darks = with_darks(sources, ctx.log)
    arrays: dict[str, Quantity] = {}
    rows: list[RecordingRow] = []
    quality: list[Check] = []
    whole: list[Resolved] = []
    for star in stars:
        with failing_alone(failures, star.input, star.raw.path, ctx.log):
            whole.append(accumulated(star, ctx.config.exposure_of(star.input)))
            for note in whole[-1].raw.notes[len(star.raw.notes) :]:
                ctx.log.info(note)
    for source, found in zip(whole, _side_by_side(ctx, whole), strict=True):
        if isinstance(found, list):
            failures += found
            continue
        with failing_alone(failures, source.input, source.raw.path, ctx.log):
            recording, cleaned = found
            told = told_of(recording, cleaned.noise, ctx.instrument.facility, _step_s(source.raw))
            told += of_counts(source.raw.adu)
            doubts = [f"{recording.name}: {one.text}" for one in told if one.warned]
            for line in (*_contradictions(recording, cleaned), *doubts):
                ctx.log.warning(line)
            rows.append(_row(recording, cleaned, source.raw, told, ctx.instrument.name))
            quality += _checks(rows[-1], told, ctx.config)
            arrays |= _arrays(recording, cleaned, source.raw)
    for name in ctx.inputs:
        if not any(row.input == name for row in rows):
            reasons = [text for owner, text in failures if owner == name]
            raise InputDataError(
                reasons[0] + and_more(reasons) if reasons else f"input '{name}': only darks, no star in it"
            )
    lines = [text for _, text in failures]
    results = IngestResults(inputs=[*rows, *map(_dark_row, darks)])
    return StageOutput(arrays, results, quality, summary=[_line(one) for one in rows], failures=lines)


def _side_by_side(
    ctx: StageContext[Config], sources: Sequence[Resolved]
) -> list[tuple[Recording, Cleaned] | list[tuple[str, str]]]:
    """Clean all recordings, or note what goes wrong; one by one where memory may not hold all at once."""

    def attempt(source: Resolved) -> tuple[Recording, Cleaned] | list[tuple[str, str]]:
        failures: list[tuple[str, str]] = []
        with failing_alone(failures, source.input, source.raw.path, ctx.log):
            return ingest(source, ctx.config, ctx.instrument)
        return failures

    # What a process returns is there twice for a while.
    roomy = 2 * sum(map(_needed_bytes, sources)) < available_bytes()
    with ctx.progress(total=len(sources), desc="ingest") as bar:
        return forked_map(ctx.jobs if roomy else 1, attempt, sources, lambda source: bar.update())


def ingest(source: Resolved, config: Config, instrument: Instrument) -> tuple[Recording, Cleaned]:
    """Clean one recording; a second time where its frames contradict the profile's detector.

    `config` limits pixels and frames, `instrument` gives the diameter of the pupil. Raises `InputDataError`
    if none of its frames can be used, all are the same image, or the noise of a single one is not known.
    """
    frames, rows, columns = source.raw.adu.shape
    where = f"{source.raw.path}: {frames} frames of {rows}x{columns} px"
    require_memory(
        _needed_bytes(source), where, InputDataError, "cut the window, or the recording into parts"
    )
    if time_is_last(source.raw.adu):
        raise InputDataError(
            f"{source.raw.path}: of its axes ({frames}, {rows}, {columns}) the last seems to be that of the "
            "frames, for the star stands still along it; write the cube with axes (frames, y, x)"
        )
    cleaned = _cleaned(source, config, instrument)
    told = source.acquisition
    detector, sources = believed(told.detector, told.sources, cleaned.noise)
    if detector != told.detector:
        acquisition = replace(told, detector=detector, sources=sources)
        source = replace(source, acquisition=acquisition)
        cleaned = _cleaned(source, config, instrument)
    told_noise = source.acquisition.sources.get(READ_NOISE, PROFILE) != PROFILE
    if source.raw.frames == 1 and not told_noise and not cleaned.noise.floor_e2 > 0:
        raise InputDataError(
            f"{source.raw.path}: one frame, and its noise is not declared nor can it be measured, "
            "for the star fills the window; add detector.read_noise_e to the side-car (of dark, sky "
            "and read-out together)"
        )
    return _recording(source, cleaned), cleaned


def _needed_bytes(source: Resolved) -> float:
    _, rows, columns = source.raw.adu.shape
    return BYTES_PER_PIXEL * rows * columns + BYTES_PER_VALUE * source.raw.adu.size


def _cleaned(source: Resolved, config: Config, instrument: Instrument) -> Cleaned:
    raw, acquisition = source.raw, source.acquisition
    # pixels per λ/D at the shortest wavelength; D is that of a lenslet in 2x2 modes
    shortest_nm = min(wavelength for wavelength, weight in acquisition.spectrum if weight > 0)
    diameter_m = instrument.pupil.diameter_m / acquisition.lenslets
    sampling = resolution_px(shortest_nm * NM, diameter_m, acquisition.pixel_scale_mas)
    limits, plane = config.part(Limits), source.introduced_defocus_nm
    cleaned = clean(raw, acquisition.detector, sampling, config.part(Thresholds), limits, plane)
    if not cleaned.used.any():
        counts = ", ".join(f"{number} x {reason}" for reason, number in tally(cleaned.reasons).items())
        overflow = next(of_counts(raw.adu))  # it brings values to the end of their type as well
        why = f"; {overflow.text}" if overflow.value else ""
        raise InputDataError(f"{raw.path}: none of the {raw.frames} frames can be used: {counts}{why}")
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
    return step_s if step_s > 0 else float("nan")  # a clock that stands gives no step


def _recording(source: Resolved, cleaned: Cleaned) -> Recording:
    raw, acquisition = source.raw, source.acquisition
    detector = replace(acquisition.detector, saturation_adu=cleaned.saturation_adu)
    return replace(
        as_declared(source),
        images_e=cleaned.images_e,
        used=cleaned.used,
        reason=cleaned.reasons,
        good=cleaned.good,
        time_s=relative_times(raw.unix_s, raw.frame_counter, acquisition.frame_rate_hz),
        acquisition=replace(acquisition, detector=detector),
        background_variance_e2=cleaned.background_variance_e2,
        dark_variance_e2=cleaned.dark_variance_e2,
        frames_missing=frames_missing(raw.frame_counter),
    )


def _arrays(recording: Recording, cleaned: Cleaned, raw: RawRecording) -> dict[str, Quantity]:
    """Return all arrays that ingest leaves of a `recording`, made from `raw` and `cleaned`."""
    hits = cleaned.hits
    rows, columns = _found_bad(recording, raw).T
    mean_adu = mean_frame(picked(raw.adu, recording.used))
    background, gain = cleaned.background, recording.acquisition.detector.e_per_adu
    own = {
        "raw_adu": raw.adu,
        "background_adu": background.adu,
        "flat": background.flat,
        "cosmic_hits": np.stack([hits.frame, hits.row, hits.column], axis=1),
        "screened_e": ((mean_adu - background.adu) / background.flat * gain)[rows, columns],
    } | frame_series(recording.images_e, recording.good)
    return arrays_from_recording(recording) | declared(RECORDING, own, below=f"{prefix_of(recording)}/")


def _found_bad(recording: Recording, raw: RawRecording) -> np.ndarray:
    """Return the bad pixels of a `recording` that no map of dead pixels of `raw` lists, (pixels, 2)."""
    listed = raw.calibration.bad
    found = ~recording.good if listed is None else ~recording.good & ~np.asarray(listed, bool)
    return np.argwhere(found)


# -- what is reported --------------------------------------------------------------------------------


def _row(
    recording: Recording, cleaned: Cleaned, raw: RawRecording, told: Sequence[Told], instrument: str
) -> RecordingRow:
    """Return the entry of a `recording` in the results."""
    acquisition, background, noise = recording.acquisition, cleaned.background, cleaned.noise
    row_px, column_px = star_position(recording.mean_e)
    window_rows, columns = recording.window
    return RecordingRow.filled_from(
        *(recording, raw, acquisition, background, noise),
        frames_rejected=int(np.sum(~recording.used)),
        flux_e=float(np.median(frame_flux(recording.images_e)[recording.used])),
        reasons=tally(recording.reason),
        saturated_frames=int(np.sum(recording.reason == SATURATED)),
        bad_pixels=np.argwhere(~recording.good).tolist(),
        bad_pixels_found=_found_bad(recording, raw).tolist(),
        clipped_pixels=np.argwhere(cleaned.clipped).tolist(),
        cosmic_hits=int(cleaned.hits.frame.size),
        centre_offset_px=(column_px - (columns - 1) / 2, row_px - (window_rows - 1) / 2),
        noise_floor_e2=noise.floor_e2,
        excess_noise_measured=noise.excess_noise_factor,
        noise=constants(acquisition.detector, acquisition.sources, noise),
        observed=Observed.filled_from(
            acquisition,
            file=raw.path.name,
            start=iso_time(recording.start_unix_s),
            cards=dict(raw.cards),
            instrument=instrument,
            diversity_nm=acquisition.diversity,
        ),
        doubts=[one.text for one in told if one.warned],
    )


def _contradictions(recording: Recording, cleaned: Cleaned) -> list[str]:
    """Return one line per constant of the detector that the frames of a `recording` contradict.

    Dark current and sky explain a noise beyond the read noise, which `cleaned` allows for.
    """
    acquisition = recording.acquisition
    return [
        f"{recording.name}: {name} = {one.used:.4g} by the {one.source}, "
        f"{one.measured:.4g} +- {one.error:.2g} by its frames"
        for name, one in constants(acquisition.detector, acquisition.sources, cleaned.noise).items()
        if one.contradicted and not (name == READ_NOISE and one.measured > one.used)
    ]


def _dark_row(source: Resolved) -> RecordingRow:
    """Return the entry of a dark recording, which has no star."""
    none = {"frames_rejected": 0, "frames_missing": 0, "flux_e": None, "mag_j": None}
    return RecordingRow.filled_from(source.raw, input=source.input, role="dark", **none)


def _checks(row: RecordingRow, told: Sequence[Told], config: Config) -> list[Check]:
    """Return the QC checks of a recording, and of what was `told` of it, with the limits of `config`."""
    wrong = [one.text for one in told if one.wrong]
    contradicted = "; ".join(wrong) or "nothing that was declared is contradicted by the frames beyond doubt"
    rejected, saturated = row.frames_rejected / row.frames, row.saturated_frames / row.frames
    missing = row.frames_missing / (row.frames + row.frames_missing)
    x_px, y_px = row.centre_offset_px
    bad, offset_px = len(row.bad_pixels) / np.prod(row.window), np.hypot(x_px, y_px)
    reasons = ", ".join(f"{number} x {reason}" for reason, number in row.reasons.items())
    why = f"frames that are rejected ({reasons or 'none'})"
    offset_limit_px = config.max_centre_offset_fraction * min(row.window)
    table = [
        ("rejected", rejected, "1", config.max_rejected_fraction, why),
        ("saturated", saturated, "1", config.max_saturated_fraction, "frames that are saturated"),
        ("missing", missing, "1", config.max_missing_fraction, "frames that the recorder lost"),
        ("bad_pixels", bad, "1", config.max_bad_pixel_fraction, "masked pixels"),
        ("centring", offset_px, "px", offset_limit_px, "distance of the star from the window's centre"),
    ]
    prefix = f"ingest/{row.input}/{row.name}"
    message = "signal above the level of the sky, or dark; negative, and it is not that of these frames"
    return [
        *(
            Check(f"{prefix}/{name}", float(value), unit, None, float(high), message)
            for name, value, unit, high, message in table
        ),
        Check(f"{prefix}/flux", row.flux_e, "e-", 0.0, None, message),
        Check(f"{prefix}/told", float(len(wrong)), "1", None, 0.0, contradicted),
    ]


def _line(entry: RecordingRow) -> str:
    """What came of a recording, for the terminal."""
    rows, columns = entry.window
    missing = f", {entry.frames_missing} missing" if entry.frames_missing else ""
    bad = f", {len(entry.bad_pixels)} bad pixels" if entry.bad_pixels else ""
    return (
        f"{entry.input} {entry.name}: {entry.frames_used} of {entry.frames} frames{missing}{bad}, "
        f"{rows}x{columns} px, {entry.flux_e:.3g} e- per frame"
    )
