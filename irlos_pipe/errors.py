"""What can go wrong on the user's side, and the exit code each kind carries."""


class IrlosError(Exception):
    """Base of every error that is told in one line instead of a traceback."""

    exit_code = 1


class ConfigurationError(IrlosError):
    """A recipe, an option or a value that cannot be used."""

    exit_code = 2


class InputDataError(IrlosError):
    """Input data that cannot be read or make no sense."""

    exit_code = 3


class NothingToDo(IrlosError):
    """No input was found."""

    exit_code = 64


class Locked(IrlosError):
    """Another run owns the output folder."""

    exit_code = 75
