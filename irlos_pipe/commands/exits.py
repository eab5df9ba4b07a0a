"""How commands end: exit codes, errors in one line, signals, and the debugger where it was asked for."""

import errno
import io
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import click

from irlos_pipe.conventions.errors import (
    EXIT_MEANINGS,
    ConfigurationError,
    ExitCode,
    IrlosError,
    UnexpectedError,
)
from irlos_pipe.conventions.text import printable

NO_OUTPUT = {errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EFBIG}
AGAIN_S = 0.01  # until a dropped signal comes again: longer than objects take to be deleted
ASKED, SIGNALS = "irlos.pdb", "irlos.signals"  # keys of what a call knows

EXIT_CODES = "\b\nExit codes:\n" + "\n".join(f"  {code:<5}{text}" for code, text in EXIT_MEANINGS.items())
SEE_EXIT_CODES = "Exit codes: irlos --help lists them."


class IrlosGroup(click.Group):
    """A group that reports every error in one line per problem and exits with the code of the error."""

    tasks: Mapping[str, Sequence[click.Command]] = {}  # the commands by what they are for

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order in which they are used."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands of each task with the first sentence of their help, whole."""
        width = max(map(len, self.commands))
        for task, commands in self.tasks.items():
            with formatter.section(task):
                formatter.write_dl([(f"{one.name:{width}}", _first_sentence(one)) for one in commands])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; of a recipe, a stage or a file that stands in its place say how it is used."""
        if args[0] not in self.commands and (hint := _instead_of(args[0])):
            ctx.fail(f"No such command '{args[0]}'. {hint}")
        return super().resolve_command(ctx, args)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        mend_streams()
        return super().main(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> object:
        with terminated_like_interrupted() as ctx.meta[SIGNALS]:
            try:
                return super().invoke(ctx)
            except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
                raise
            except (KeyboardInterrupt, Exception) as error:
                # A library may take the interrupt for a fault of what it was doing.
                interrupted = isinstance(error, KeyboardInterrupt) or ctx.meta[SIGNALS]
                ctx.exit(_reported(KeyboardInterrupt() if interrupted else error, ctx))


def _first_sentence(command: click.Command) -> str:
    text = " ".join((command.help or "").partition("\n\n")[0].split())
    return text.partition(". ")[0].rstrip(".") + "."


def _instead_of(name: str) -> str:
    """What to type instead of the name of a recipe, a stage or a file."""
    from irlos_pipe.commands.completion import content_of
    from irlos_pipe.files.shipped import RECIPES, shipped_names

    if os.path.exists(name):
        return f"irlos show {name} says what can be done with it."
    having = [one for one in shipped_names(RECIPES) if name in (one, *content_of(one)["stages"])]
    having.sort(key=lambda one: name[:5] not in one)
    return f"A recipe does that: irlos run {having[0]}" if having else ""


def _reported(error: BaseException, ctx: click.Context) -> ExitCode:
    """The exit code of an `error`, after it was reported."""
    if isinstance(error, KeyboardInterrupt):
        report_error("interrupted; finished products are kept, run the same command to continue")
        return ExitCode.INTERRUPTED
    if isinstance(error, IrlosError):
        # of a configuration a line for each error, of anything else one
        text = str(error) or type(error).__name__
        report_error(text if isinstance(error, ConfigurationError) else " ".join(text.splitlines()))
        if isinstance(error, UnexpectedError):
            _debug_if_asked(ctx, error)
        return error.exit_code
    if isinstance(error, OSError) and error.filename:  # a path that was given
        report_error(f"{error.filename}: {error.strerror}")
        return ExitCode.BAD_DATA
    if isinstance(error, OSError) and error.errno in NO_OUTPUT:
        report_error(f"the output cannot be written: {error.strerror}")
        silence(1)
        return ExitCode.UNEXPECTED
    report_error(f"unexpected {type(error).__name__}: {error}; the traceback is in {_saved_traceback()}")
    _debug_if_asked(ctx, error)
    return ExitCode.UNEXPECTED


def report_error(message: str) -> None:
    """Write the lines of an error `message` to stderr."""
    with suppress(OSError, ValueError):  # nothing is left to report to
        for line in message.split("\n"):
            click.echo(f"irlos: error: {printable(line)}", err=True)


@contextmanager
def terminated_like_interrupted() -> Iterator[list[int]]:
    """End the block on SIGTERM or SIGHUP as on Ctrl-C, so that no unfinished files are left.

    Yields the list of the signals that came, Ctrl-C's among them. One that comes while an object is deleted,
    where Python drops every exception, comes again a moment later.
    """
    came: list[int] = []
    again: list[threading.Timer] = []

    def end(number: int, _: object) -> None:
        came.append(number)
        raise KeyboardInterrupt

    def dropped(what: "sys.UnraisableHookArgs") -> None:
        if not isinstance(what.exc_value, KeyboardInterrupt):
            hook(what)
            return
        again.append(threading.Timer(AGAIN_S, os.kill, (os.getpid(), came[-1])))
        again[-1].start()

    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    for number, handler in previous.items():
        if handler != signal.SIG_IGN:  # as under nohup
            signal.signal(number, end)
    hook, sys.unraisablehook = sys.unraisablehook, dropped
    try:
        yield came
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = hook
        for number, handler in previous.items():
            signal.signal(number, handler)


def mend_streams() -> None:
    """Open the streams that the caller closed, and print what the terminal's letters lack as escapes."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            silence(number)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def silence(number: int) -> None:
    """Let the stream with this `number` lead to nowhere."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)


def _saved_traceback() -> str:
    try:
        with tempfile.NamedTemporaryFile("w", prefix="irlos-", suffix=".log", delete=False) as file:
            traceback.print_exc(file=file)
    except OSError as error:
        return f"no file ({error.strerror})"
    return file.name


def pdb_option(*, hidden: bool) -> click.Option:
    """Return the option ``--pdb``, which the program and every command have; only the former shows it."""
    return click.Option(
        ["--pdb"],
        is_flag=True,
        hidden=hidden,
        expose_value=False,
        callback=_ask,
        help="Open the debugger where an unexpected error happens; needs a terminal.",
    )


def _at_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _ask(context: click.Context, _option: click.Parameter, value: bool) -> None:
    if value and not _at_terminal():
        raise click.UsageError("--pdb needs a terminal: the debugger would wait for answers forever")
    if value:
        context.meta[ASKED] = True


def _debug_if_asked(context: click.Context, error: BaseException) -> None:
    """Open the debugger on the last frame of an unexpected error, or of its cause, if ``--pdb`` was given."""
    if not context.meta.get(ASKED):
        return
    import pdb

    cause = error.__cause__ if isinstance(error, UnexpectedError) else error
    if cause is not None:
        traceback.print_exception(cause)
        pdb.post_mortem(cause.__traceback__)
