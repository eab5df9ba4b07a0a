"""A limit of time; truth is the clock of the test, with room for a busy machine."""

import subprocess
import sys
import time

import pytest

from irlos_pipe.files import processes
from irlos_pipe.files.processes import TookTooLong


def test_what_sleeps_too_long_is_stopped_with_a_line():
    start = time.monotonic()
    with (
        pytest.raises(TookTooLong, match="reading it: took longer than"),
        processes.time_limit(0.1, "reading it"),
    ):
        time.sleep(30)
    assert time.monotonic() - start < 25


@pytest.mark.slow
def test_a_worker_that_does_not_even_hear_of_it_is_killed():
    code = (
        "import signal, time; from irlos_pipe.files import processes as t; t.GRACE_S = 0.1\n"
        "with t.time_limit(0.1, 'x', kill=True):\n"
        "    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM}); time.sleep(60)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=50).returncode == -9
