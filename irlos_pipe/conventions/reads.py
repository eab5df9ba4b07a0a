"""Reads of the detector that are added up to an exposure."""

from irlos_pipe.conventions.errors import ConfigurationError

TOLERANCE = 0.02  # relative error by which whole reads may miss the exposure


def whole_reads(exposure_s: float, read_s: float) -> int:
    """Return the number of reads of `read_s` that make up an exposure of `exposure_s`.

    Raises `ConfigurationError` when no whole number of reads does.
    """
    reads = max(1, round(exposure_s / read_s))
    if not adds_up(exposure_s, read_s, reads):
        raise ConfigurationError(
            f"reads of {read_s:g} s do not add up to exposure_s = {exposure_s:g} ({exposure_s / read_s:.4g} "
            "reads); give a read_s that divides it"
        )
    return reads


def adds_up(exposure_s: float, read_s: float, reads: int) -> bool:
    """Return whether so many `reads` of `read_s` make up an exposure of `exposure_s`."""
    return abs(reads * read_s / exposure_s - 1) <= TOLERANCE
