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
