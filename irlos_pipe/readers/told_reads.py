"""How many reads make up a frame: as told, and whether that agrees with the exposure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.reads import adds_up, whole_reads
from irlos_pipe.frames.recording import PROFILE

COADDS, READ_S, READ_NOISE = "detector.coadds", "detector.read_s", "detector.read_noise_e"


def reads_of(values: Mapping[str, Any], sources: Mapping[str, str], where: str) -> int:
    """Return the number of reads in a frame.

    As told; else as many as told reads fill the exposure. The profile's read noise is that of one read: with
    it and no word of reads, a frame has as many of the profile's reads as its exposure takes.

    Parameters
    ----------
    values, sources : mapping
        Of every side-car key, and where it came from.
    where : str
        Begins messages.

    Raises
    ------
    InputDataError
        When the reads do not add up to the exposure.
    """
    told = {key for key in (COADDS, READ_S) if sources.get(key, PROFILE) != PROFILE}
    exposure_s = values.get("exposure_s")
    if READ_S in told and exposure_s is not None:
        return _filling(values, exposure_s, where)
    if COADDS in told:
        return values[COADDS]
    if sources.get(READ_NOISE, PROFILE) == PROFILE and READ_S in values and exposure_s is not None:
        return max(1, round(exposure_s / values[READ_S]))
    return 1


def _filling(values: Mapping[str, Any], exposure_s: float, where: str) -> int:
    read_s, coadds = values[READ_S], values.get(COADDS)
    if coadds is None:
        try:
            return whole_reads(exposure_s, read_s)
        except ConfigurationError as problem:
            raise InputDataError(f"{where} {problem}") from None
    if not adds_up(exposure_s, read_s, coadds):
        raise InputDataError(
            f"{where} detector.coadds = {coadds} reads of read_s = {read_s:g} s do not add up to "
            f"exposure_s = {exposure_s:g}; correct one of them"
        )
    return coadds
