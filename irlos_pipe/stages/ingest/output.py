"""What ingest reports of each recording: its row in results.json, its QC checks, its line on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.frames.believed_detector import READ_NOISE, constants
from irlos_pipe.frames.blocks import frame_flux
from irlos_pipe.frames.cleaning import Cleaned
from irlos_pipe.frames.detector import star_position
from irlos_pipe.frames.recording import Recording
from irlos_pipe.frames.screening import SATURATED, tally
from irlos_pipe.frames.told import Told
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Observed
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.times import iso_time
from irlos_pipe.stages.ingest.config import Config
from irlos_pipe.stages.ingest.recording_arrays import found_bad
from irlos_pipe.stages.ingest.results import NoiseRow, RecordingRow
from irlos_pipe.stages.ingest.sources import Source


def row(
    recording: Recording,
    cleaned: Cleaned,
    raw: RawRecording,
    told: Sequence[Told] = (),
    instrument: str = "",
) -> RecordingRow:
    """Return the entry of a `recording` in the results.

    Parameters
    ----------
    recording : Recording
        Its clean frames.
    cleaned : Cleaned
        What was found on the way.
    raw : RawRecording
        What it was made from.
    told : sequence of Told
        What was told of it, against what its frames show.
    instrument : str
        Name of the instrument profile.
    """
    acquisition = recording.acquisition
    return RecordingRow(
        name=recording.name,
        input=recording.input,
        role=acquisition.role,
        layout=raw.layout,
        mode=raw.mode,
        frames=raw.frames,
        window=raw.window,
        frames_rejected=int(np.sum(~recording.used)),
        frames_missing=recording.frames_missing,
        flux_e=float(np.median(frame_flux(recording.images_e)[recording.used])),
        mag_j=acquisition.mag_j,
        reasons=tally(recording.reason),
        saturated_frames=int(np.sum(recording.reason == SATURATED)),
        bad_pixels=np.argwhere(~recording.good).tolist(),
        bad_pixels_found=found_bad(recording, raw).tolist(),
        clipped_pixels=np.argwhere(cleaned.clipped).tolist(),
        cosmic_hits=int(cleaned.hits.frame.size),
        centre_offset_px=centre_offset_px(recording),
        pedestal_adu=cleaned.background.pedestal_adu,
        pedestal_error_adu=cleaned.background.pedestal_error_adu,
        noise_floor_e2=cleaned.noise.floor_e2,
        excess_noise_measured=cleaned.noise.excess_noise_factor,
        background_variance_e2=recording.background_variance_e2,
        dark_variance_e2=recording.dark_variance_e2,
        noise={
            one.name: NoiseRow(used=one.used, source=one.source, measured=one.measured, error=one.error)
            for one in constants(acquisition.detector, acquisition.sources, cleaned.noise)
        },
        corner_scatter_e=cleaned.noise.corner_scatter_e,
        sources=acquisition.sources,
        observed=observed(recording, raw, instrument),
        doubts=[one.text for one in told if one.warned],
    )


def observed(recording: Recording, raw: RawRecording, instrument: str) -> Observed:
    """Return what products hand on of a `recording` that was made from `raw`, under a profile's name."""
    acquisition = recording.acquisition
    same = ("target", "mode", "exposure_s", "frame_rate_hz", "mag_j", "pixel_scale_mas", "diversity_source")
    angles = ("derotator_angle_deg", "parallactic_angle_deg", "altitude_deg", "pupil_rotation_deg")
    return Observed(
        file=raw.path.name,
        start=iso_time(recording.start_unix_s),
        cards=dict(raw.cards),
        instrument=instrument,
        wavelength_nm=acquisition.wavelength_nm,
        diversity_nm=acquisition.diversity,
        **{name: getattr(acquisition, name) for name in (*same, *angles)},
    )


def told_check(recording: Recording, told: Sequence[Told]) -> Check:
    """Return the check that fails where the frames of a `recording` contradict what was `told` of it."""
    wrong = [one.text for one in told if one.wrong]
    message = "; ".join(wrong) or "nothing that was told is contradicted by the frames beyond doubt"
    name = f"ingest/{recording.input}/{recording.name}/told"
    return Check(name, float(len(wrong)), "1", None, 0.0, message)


def contradictions(recording: Recording, cleaned: Cleaned) -> list[str]:
    """Return one line per constant of the detector that the frames of a `recording` contradict.

    Dark current and sky explain a noise beyond the read noise, which `cleaned` allows for.
    """
    acquisition = recording.acquisition
    return [
        f"{recording.name}: {one.name} = {one.used:.4g} by the {one.source}, "
        f"{one.measured:.4g} +- {one.error:.2g} by its frames"
        for one in constants(acquisition.detector, acquisition.sources, cleaned.noise)
        if one.contradicted and not (one.name == READ_NOISE and one.measured > one.used)
    ]


def dark_row(source: Source) -> RecordingRow:
    """Return the entry of a dark recording, which has no star."""
    raw = source.raw
    return RecordingRow(
        name=raw.name,
        input=source.input,
        role="dark",
        layout=raw.layout,
        mode=raw.mode,
        frames=raw.frames,
        window=raw.window,
        frames_rejected=0,
        frames_missing=0,
        flux_e=None,
        mag_j=None,
    )


def centre_offset_px(recording: Recording) -> tuple[float, float]:
    """Return the position (x, y) of the star in the mean image against the window's centre [px]."""
    row_px, column_px = star_position(recording.mean_e)
    rows, columns = recording.window
    return column_px - (columns - 1) / 2, row_px - (rows - 1) / 2


def checks(recording: Recording, config: Config) -> list[Check]:
    """Return the QC checks of a `recording`, with the limits of `config`."""
    saturated = np.mean(recording.reason == SATURATED)
    missing = recording.frames_missing / (recording.frames + recording.frames_missing)
    offset_px = np.hypot(*centre_offset_px(recording))
    offset_limit_px = config.max_centre_offset_fraction * min(recording.window)
    table = [
        ("rejected", np.mean(~recording.used), "1", config.max_rejected_fraction, _list_reasons(recording)),
        ("saturated", saturated, "1", config.max_saturated_fraction, "frames that are saturated"),
        ("missing", missing, "1", config.max_missing_fraction, "frames that the recorder lost"),
        ("bad_pixels", np.mean(~recording.good), "1", config.max_bad_pixel_fraction, "masked pixels"),
        ("centring", offset_px, "px", offset_limit_px, "distance of the star from the window's centre"),
    ]
    prefix = f"ingest/{recording.input}/{recording.name}"
    flux_e = float(np.median(frame_flux(recording.images_e)[recording.used]))
    message = "signal above the level of the sky, or dark; negative, and it is not that of these frames"
    return [
        *(
            Check(f"{prefix}/{name}", float(value), unit, None, float(high), message)
            for name, value, unit, high, message in table
        ),
        Check(f"{prefix}/flux", flux_e, "e-", 0.0, None, message),
    ]


def _list_reasons(recording: Recording) -> str:
    found = ", ".join(f"{number} x {reason}" for reason, number in tally(recording.reason).items())
    return f"frames that are rejected ({found or 'none'})"


def summary(rows: Sequence[RecordingRow]) -> list[str]:
    """Return one line per recording for the terminal."""
    return [_line(entry) for entry in rows]


def _line(entry: RecordingRow) -> str:
    rows, columns = entry.window
    missing = f", {entry.frames_missing} missing" if entry.frames_missing else ""
    bad = f", {len(entry.bad_pixels)} bad pixels" if entry.bad_pixels else ""
    return (
        f"{entry.input} {entry.name}: {entry.frames_used} of {entry.frames} frames{missing}{bad}, "
        f"{rows}x{columns} px, {entry.flux_e:.3g} e- per frame"
    )
