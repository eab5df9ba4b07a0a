"""How commands end: exit codes, errors in one line, signals."""

from __future__ import annotations

import signal
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from irlos_pipe.conventions.errors import ConfigurationError, ExitCode, IrlosError

EXIT_CODES = """\b
Exit codes:
  0    done, or already up to date
  1    unexpected error (the message names the file with the traceback), or no space to write
  2    usage or configuration
  3    bad input data
  4    a QC check failed (products are written)
  5    partial: some exposures failed (products are written)
  64   nothing to process
  75   the output folder is in use by another run
  130  interrupted
"""


class IrlosGroup(click.Group):
    """A group that reports every error in one line per problem and exits with the code of the error."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """See `click.Group.list_commands`; here in the order in which they are used."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> object:
        """See `click.Group.invoke`."""
        try:
            return super().invoke(ctx)
        except IrlosError as error:
            report_error(_lines(error))
            ctx.exit(error.exit_code)
        except KeyboardInterrupt:
            report_error("interrupted; finished products are kept, run the same command to continue")
            ctx.exit(ExitCode.INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.filename:  # a path that was given
                report_error(f"{error.filename}: {error.strerror}")
                ctx.exit(ExitCode.BAD_DATA)
            report_error(
                f"unexpected {type(error).__name__}: {error}; the traceback is in {_saved_traceback()}"
            )
            ctx.exit(ExitCode.UNEXPECTED)


def _lines(error: IrlosError) -> str:
    """All errors of a configuration, a line each; anything else in one line."""
    text = str(error) or type(error).__name__
    return text if isinstance(error, ConfigurationError) else " ".join(text.splitlines())


def report_error(message: str) -> None:
    """Write the lines of an error `message` to stderr."""
    for line in message.splitlines():
        click.echo(f"irlos: error: {line}", err=True)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """End the block on SIGTERM as on Ctrl-C, so that no unfinished files are left."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def _saved_traceback() -> Path:
    with tempfile.NamedTemporaryFile("w", prefix="irlos-", suffix=".log", delete=False) as file:
        traceback.print_exc(file=file)
    return Path(file.name)
