"""Closed, full and foreign terminals, names that steer them, and signals."""

import errno
import io
import os
import signal
import subprocess
import sys
import time

import click
import pytest
from click.testing import CliRunner
from conftest import invoke

from irlos_pipe.commands import exits
from irlos_pipe.commands.exits import IrlosGroup, mend_streams, report_error, terminated_like_interrupted
from irlos_pipe.conventions.errors import ConfigurationError, ExitCode, InputDataError
from irlos_pipe.pipeline.runlog import RUN
from irlos_pipe.pipeline.terminal import messages

SCRIPT = """
import os, sys
from irlos_pipe.commands.exits import mend_streams
mend_streams()
sys.stderr.isatty()
print("–")
print("lost", file=sys.stderr)
os.write(int(sys.argv[1]), str([os.fstat(n).st_rdev for n in (0, 1, 2)]).encode())
"""


def test_closed_streams_lead_to_nowhere_and_not_into_the_next_file_that_is_opened():
    reading, writing = os.pipe()
    shell = f'exec "$0" -c "$1" {writing} <&- >&- 2>&-'
    command = ["sh", "-c", shell, sys.executable, SCRIPT]
    assert subprocess.run(command, pass_fds=[writing], check=False).returncode == 0
    os.close(writing)
    with open(reading) as answer:
        assert answer.read() == str([os.stat(os.devnull).st_rdev] * 3)


def test_what_a_terminal_cannot_show_is_printed_as_an_escape(monkeypatch):
    """U+2013 is not in ISO 8859-1."""
    bytes_written = io.BytesIO()
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(bytes_written, encoding="latin-1"))
    mend_streams()
    print("1 – 2 µm", flush=True)
    assert bytes_written.getvalue() == "1 \\u2013 2 µm\n".encode("latin-1")


def group(error: Exception) -> IrlosGroup:
    @click.group(cls=IrlosGroup)
    def commands() -> None:
        pass

    @commands.command()
    def work() -> None:
        raise error

    return commands


def test_a_full_disk_behind_stdout_is_one_line(monkeypatch):
    silenced = []
    monkeypatch.setattr(exits, "silence", silenced.append)
    result = CliRunner().invoke(group(OSError(errno.ENOSPC, "No space left on device")), ["work"])
    assert (result.exit_code, silenced) == (1, [1])
    assert result.output == "irlos: error: the output cannot be written: No space left on device\n"


def test_a_name_can_neither_fake_a_line_nor_steer_the_terminal():
    name = "a\nirlos: error: all is lost \x1b[2J\udcff"
    result = CliRunner().invoke(group(InputDataError(f"{name!s}: damaged")), ["work"])
    assert result.output.count("\n") == 1 and "\x1b" not in result.output and "\\udcff" in result.output


@pytest.mark.parametrize("error", [OSError(errno.EPIPE, "Broken pipe"), ValueError("closed file")])
def test_a_terminal_that_is_gone_stops_nothing(monkeypatch, error):
    class Gone(io.StringIO):
        def write(self, _):
            raise error

    monkeypatch.setattr(sys, "stderr", Gone())
    with messages(0):
        RUN.info("at work")
    report_error("lost")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_lost_connection_ends_a_command_like_ctrl_c(number):
    before = signal.signal(number, signal.SIG_DFL)  # whoever runs the tests may ignore it, as nohup does
    try:
        with pytest.raises(KeyboardInterrupt), terminated_like_interrupted():
            os.kill(os.getpid(), number)
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_a_library_takes_for_bad_input_ends_a_command_all_the_same(number):
    @click.group(cls=IrlosGroup)
    def program() -> None: ...

    @program.command()
    def read() -> None:
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt:
            raise ConfigurationError("recipe.yaml:1: should match a pattern") from None

    result = CliRunner().invoke(program, ["read"])
    assert result.exit_code == ExitCode.INTERRUPTED
    assert "interrupted" in result.stderr and "pattern" not in result.stderr


def test_a_signal_that_comes_while_an_object_is_deleted_is_not_lost():
    class Deleted:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt), terminated_like_interrupted() as came:
        Deleted()
        time.sleep(10.0)
    assert came == 2 * [signal.SIGTERM]


def test_under_nohup_a_lost_connection_ends_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with terminated_like_interrupted():
            os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("output", ["", "a\nb", b"\xff"])
def test_an_output_without_a_name_that_can_be_shown_is_refused(bench, output):
    """An unset variable gives the empty name, which would be the current folder."""
    result = invoke("run", str(bench.recipe), "--output", os.fsdecode(output))
    assert (result.exit_code == 2 and "give a path" in result.output) or "cannot be shown" in result.output
