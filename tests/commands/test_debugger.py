"""--pdb opens the debugger on a fault of the software, at a terminal and nowhere else."""

import os
import pty
import subprocess
import sys
from contextlib import suppress

import pytest
from conftest import Bench, invoke
from helpers.paths import REPOSITORY


def at_terminal(bench: Bench, *call: str, typed: bytes) -> tuple[int, str]:
    """Exit code and what a terminal shows when the stand-in stages run in it and somebody types."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "helpers.fake_stages", *call],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        cwd=REPOSITORY / "tests",
        env=os.environ | {"PYTHONPATH": f"{REPOSITORY}{os.pathsep}{REPOSITORY / 'tests'}"},
    )
    os.close(slave)
    os.write(master, typed)
    shown = b""
    with suppress(OSError):  # the other end was closed
        while part := os.read(master, 4096):
            shown += part
    os.close(master)
    return process.wait(), shown.decode()


@pytest.mark.slow
def test_a_crash_at_a_terminal_leaves_the_user_where_it_happened(bench):
    bench.make("calibrate.crash")
    call = ("run", str(bench.recipe), "--output", str(bench.output), "--device", "cpu", "--pdb")
    code, shown = at_terminal(bench, *call, typed=b"p 'here', name\nq\n")
    assert "ZeroDivisionError: a bug" in shown and "('here', 'calibrate')" in shown
    assert code == 1


@pytest.mark.parametrize("call", [("--pdb", "run"), ("run", "--pdb")])
def test_without_a_terminal_nothing_is_run(bench, call):
    result = invoke(*call, str(bench.recipe), "--output", str(bench.output))
    assert result.exit_code == 2 and "--pdb needs a terminal" in result.stderr
    assert not bench.output.exists()


def test_an_error_that_the_user_can_mend_opens_no_debugger(bench, monkeypatch):
    monkeypatch.setattr("irlos_pipe.commands.exits._at_terminal", lambda: True)
    monkeypatch.setattr("pdb.post_mortem", lambda _: pytest.fail("opened"))
    bench.make("calibrate.bad_data")
    assert bench.run("--pdb").exit_code == 3
    assert invoke("--pdb", "validate", "no_such_recipe").exit_code == 2
