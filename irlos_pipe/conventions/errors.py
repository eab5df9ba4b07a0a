"""Errors on the user's side, and the exit code that each kind carries."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of all commands."""

    DONE = 0
    UNEXPECTED = 1
    CONFIGURATION = 2
    BAD_DATA = 3
    QUALITY = 4
    PARTIAL = 5
    NOTHING_TO_DO = 64
    LOCKED = 75
    INTERRUPTED = 130


EXIT_MEANINGS = {
    ExitCode.DONE: "done, or already up to date",
    ExitCode.UNEXPECTED: "unexpected error (the message names the file with the traceback), "
    "or no space to write",
    ExitCode.CONFIGURATION: "usage or configuration",
    ExitCode.BAD_DATA: "bad input data",
    ExitCode.QUALITY: "a QC check failed (products are written)",
    ExitCode.PARTIAL: "partial: some exposures failed (products are written)",
    ExitCode.NOTHING_TO_DO: "nothing to process",
    ExitCode.LOCKED: "the output folder is in use by another run",
    ExitCode.INTERRUPTED: "interrupted; the same command goes on",
}


class IrlosError(Exception):
    """Base of every error that is reported in one line instead of a traceback."""

    exit_code = ExitCode.UNEXPECTED


class UnexpectedError(IrlosError):
    """A fault of the software, whose cause is what was raised."""


class ConfigurationError(IrlosError):
    """A recipe, an option or a value that cannot be used."""

    exit_code = ExitCode.CONFIGURATION


class InputDataError(IrlosError):
    """Input data that cannot be read or make no sense."""

    exit_code = ExitCode.BAD_DATA


class NothingToDo(IrlosError):
    """No input was found."""

    exit_code = ExitCode.NOTHING_TO_DO


class Locked(IrlosError):
    """Another run owns the output folder."""

    exit_code = ExitCode.LOCKED
