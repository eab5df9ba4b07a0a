"""The debugger on an unexpected error, where somebody asked for it and sits at a terminal."""

from __future__ import annotations

import sys
import traceback

import click

from irlos_pipe.conventions.errors import UnexpectedError

ASKED = "irlos.pdb"


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


def _ask(context: click.Context, _option: click.Parameter, value: bool) -> None:
    if value and not _at_terminal():
        raise click.UsageError("--pdb needs a terminal: the debugger would wait for answers forever")
    if value:
        context.meta[ASKED] = True


def _at_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def debug_if_asked(context: click.Context, error: Exception) -> None:
    """Open the debugger on the last frame of an unexpected error, if ``--pdb`` was given.

    Parameters
    ----------
    context : click.Context
        Of the program or of a command.
    error : Exception
        If it is an `UnexpectedError`, the debugger opens on its cause.
    """
    if not context.meta.get(ASKED):
        return
    import pdb

    cause = error.__cause__ if isinstance(error, UnexpectedError) else error
    if cause is not None:
        traceback.print_exception(cause)
        pdb.post_mortem(cause.__traceback__)
