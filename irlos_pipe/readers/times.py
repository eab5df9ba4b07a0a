"""When frames were taken: time columns, and pairing of two tables by their frame counters."""

import math
from contextlib import suppress
from datetime import UTC, datetime

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.readers.fitsfile import header_number

SECONDS_COLUMNS = ("Seconds", "Sec")
MICROSECONDS_COLUMNS = ("USeconds", "USec")
LATEST_UNIX_S = 4102444800  # the year 2100, beyond which a time is not credible
MJD_OF_1970, DAY_S = 40587, 86400


def column(table: fits.BinTableHDU, *names: str) -> np.ndarray | None:
    """Return the first column of `names` that the `table` has, whatever its case, or None."""
    by_lower = {name.lower(): name for name in table.columns.names}
    for name in names:
        if name.lower() in by_lower:
            return table.data[by_lower[name.lower()]]
    return None


def unix_seconds(table: fits.BinTableHDU) -> np.ndarray | None:
    """Return the times of the rows of a table [s since 1970], float64.

    None if there are no time columns or they hold only zeros, which is how SPARTA leaves them when the clock
    was not connected.
    """
    seconds = column(table, *SECONDS_COLUMNS)
    if seconds is None:
        return None
    times = seconds.astype(np.float64)
    microseconds = column(table, *MICROSECONDS_COLUMNS)
    if microseconds is not None:
        times = times + microseconds.astype(np.float64) * 1e-6
    return times if np.any(times != 0) else None


def require_times(times_s: np.ndarray, where: str) -> None:
    """Raise InputDataError if `times_s` are no times from 1970 to 2100; `where` begins the message."""
    wrong = np.flatnonzero(~((times_s >= 0) & (times_s < LATEST_UNIX_S)))
    if wrong.size or times_s.ndim != 1:
        row = wrong[0] if wrong.size else 0
        raise InputDataError(f"{where}: {times_s[row]!r} s in row {row + 1} is no time from 1970 to 2100")


def start_of(header: fits.Header) -> float:
    """Return when the recording of a `header` began [s since 1970]; NaN where it does not say so.

    DATE-OBS (DATE-BEG), else MJD-OBS (MJD-BEG). A date that is only a day gives way to MJD-OBS, or takes the
    time of the day from TIME-OBS, UT or UTC.
    """
    dates = _texts(header, "DATE-OBS", "DATE-BEG")
    days = [date for date in dates if ":" not in date]
    by_mjd = [header_number(header, key) for key in ("MJD-OBS", "MJD-BEG")]
    found = [
        *(_unix(date) for date in dates if ":" in date),
        *((mjd - MJD_OF_1970) * DAY_S for mjd in by_mjd if mjd is not None),
        *(_unix(f"{day}T{time}") for day in days for time in _texts(header, "TIME-OBS", "UT", "UTC")),
        *map(_unix, days),
    ]
    return next((time for time in found if 0 < time < LATEST_UNIX_S), float("nan"))


def _texts(header: fits.Header, *keys: str) -> list[str]:
    return [str(header.get(key, "")).strip().removesuffix("Z") for key in keys]


def _unix(stamp: str) -> float:
    """UTC, unless the stamp ends with an offset from it, such as +01:00."""
    from astropy.time import Time

    with suppress(ValueError):
        return float(Time(stamp, scale="utc").unix)
    with suppress(ValueError):
        local = datetime.fromisoformat(stamp)
        return local.timestamp() if local.tzinfo else math.nan
    return math.nan


def iso_time(unix_s: float) -> str:
    """Return a time [s since 1970] as UTC in ISO 8601 to the millisecond; "" if it is not known."""
    if not np.isfinite(unix_s):
        return ""
    return datetime.fromtimestamp(round(unix_s, 3), UTC).isoformat(timespec="milliseconds")[:23]


def counter_step(frame_counter: np.ndarray) -> int:
    """Return the usual increment of a frame counter; 1 if there is nothing to judge by.

    A recorder that keeps every 20th frame of the loop counts in steps of 20.
    """
    steps = np.diff(np.unique(frame_counter))
    return max(1, int(np.quantile(steps, 0.5, method="lower"))) if steps.size else 1


def frames_missing(frame_counter: np.ndarray) -> int:
    """Return the number of frames lost by the recorder, from gaps in its counter."""
    steps = np.diff(np.unique(frame_counter)) / counter_step(frame_counter)
    return int(np.sum(np.maximum(np.rint(steps) - 1, 0)))


def relative_times(
    unix_s: np.ndarray | None, frame_counter: np.ndarray, frame_rate_hz: float | None
) -> np.ndarray:
    """Return the time of every frame since the first one [s].

    Times `unix_s` (frames,) are NaN where not known. Frames without one are placed by their `frame_counter`:
    between their neighbours where others have a time, else at `frame_rate_hz`, or one per second.
    """
    frames = (frame_counter - frame_counter[0]) / counter_step(frame_counter)
    known = np.zeros(frames.shape, dtype=bool) if unix_s is None else np.isfinite(unix_s)
    if unix_s is None or known.sum() < 2:
        return frames / (frame_rate_hz or 1.0)
    order = np.argsort(frames[known], kind="stable")
    times = np.where(known, unix_s, np.interp(frames, frames[known][order], unix_s[known][order]))
    return times - times[0]
