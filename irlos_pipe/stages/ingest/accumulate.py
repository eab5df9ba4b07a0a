"""Raw frames of a few milliseconds, summed to the exposures of 0.1 to 2 s that the reduction wants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.reads import adds_up
from irlos_pipe.frames.recording import CalibrationMaps
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.times import counter_step
from irlos_pipe.stages.ingest.sources import Source

SHORT_COUNTS = 2  # bytes; counts of a converter end with their type, sums of them do not


def accumulated(source: Source, exposure_s: float) -> Source:
    """Return a recording with its frames summed to exposures of `exposure_s`; longer ones stay as they are.

    Sums lie on a grid of frame counters that begins with the first frame: of frames that follow each other
    without a gap, at one introduced defocus. What fills no sum is left out. A pixel that is saturated in one
    of the frames is so in their sum.

    Parameters
    ----------
    source : Source
    exposure_s : float
        Of a sum.

    Raises
    ------
    InputDataError
        When the exposure of the frames is not known or does not divide `exposure_s`, or no sum is whole.
    """
    raw, resolved = source.raw, source.resolved
    count = _frames_in_sum(source, exposure_s)
    if count == 1:
        return source
    members = _members(raw.frame_counter, resolved.introduced_defocus_nm, count)
    if not len(members):
        raise InputDataError(
            f"{raw.path}: no {count} of its {raw.frames} frames follow each other without a gap, as "
            f"accumulate_s = {exposure_s:g} needs; lower it"
        )
    told = resolved.acquisition
    level = _saturation_adu(raw.adu, told.detector.saturation_adu)
    detector = replace(told.detector, saturation_adu=level).accumulated(count)
    rate_hz = None if told.frame_rate_hz is None else told.frame_rate_hz / count
    acquisition = replace(
        told, exposure_s=count * (told.exposure_s or 0.0), frame_rate_hz=rate_hz, detector=detector
    )
    first = members[:, 0]
    return replace(
        source,
        raw=_summed(raw, members, level),
        resolved=replace(
            resolved,
            acquisition=acquisition,
            introduced_defocus_nm=resolved.introduced_defocus_nm[first],
        ),
    )


def _frames_in_sum(source: Source, exposure_s: float) -> int:
    own_s, path = source.resolved.acquisition.exposure_s, source.raw.path
    if own_s is None:
        raise InputDataError(f"{path}: exposure_s is not known; accumulate_s needs it")
    count = max(1, round(exposure_s / own_s))
    if own_s < exposure_s and not adds_up(exposure_s, own_s, count):
        raise InputDataError(
            f"{path}: frames of {own_s:g} s do not add up to accumulate_s = {exposure_s:g} "
            f"({exposure_s / own_s:.4g} frames); give a multiple"
        )
    return count


def _members(counter: np.ndarray, introduced_nm: np.ndarray, count: int) -> np.ndarray:
    """Indices of the frames of every whole sum, (sums, count)."""
    place, off = np.divmod(counter - counter[0], counter_step(counter))
    order = np.flatnonzero((off == 0) & (place >= 0))
    order = order[np.argsort(place[order], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(place[order] // count)) + 1)
    whole = [
        group
        for group in groups
        if len(group) == count and np.all(np.diff(place[group]) == 1) and np.ptp(introduced_nm[group]) == 0
    ]
    return np.array(whole, dtype=int).reshape(-1, count)


def _saturation_adu(adu: np.ndarray, told_adu: float | None) -> float | None:
    short = adu.dtype.kind in "iu" and adu.dtype.itemsize <= SHORT_COUNTS
    return told_adu if told_adu is not None or not short else float(np.iinfo(adu.dtype).max)


def _summed(raw: RawRecording, members: np.ndarray, level_adu: float | None) -> RawRecording:
    count, maps, first = members.shape[1], raw.calibration, members[:, 0]
    sums = np.stack([_sum_adu(raw.adu[group], level_adu) for group in members])
    darks = CalibrationMaps(
        None if maps.dark_adu is None else count * maps.dark_adu,
        count**2 * maps.dark_variance_adu2,
        None if maps.background_adu is None else count * maps.background_adu,
        maps.flat,
        maps.bad,
    )
    note = f"{raw.path}: {raw.frames} frames summed to {len(members)} of {count} each"
    return replace(
        raw,
        adu=sums,
        frame_counter=raw.frame_counter[first],
        calibration=darks,
        unix_s=None if raw.unix_s is None else raw.unix_s[first],
        notes=(*raw.notes, note),
    )


def _sum_adu(frames_adu: np.ndarray, level_adu: float | None) -> np.ndarray:
    """Sum of frames: int32 of counts that end at 16 bits, else float64."""
    short = frames_adu.dtype.kind in "iu" and frames_adu.dtype.itemsize <= SHORT_COUNTS
    total = frames_adu.sum(axis=0, dtype=np.int64 if short else np.float64)
    if level_adu is not None:
        total = np.where((frames_adu >= level_adu).any(axis=0), len(frames_adu) * level_adu, total)
    return total.astype(np.int32) if short else total
