"""The first image of a FITS file."""

import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files import processes
from irlos_pipe.files.processes import TookTooLong, forked_map
from irlos_pipe.files.regular import first_image


def test_image_behind_a_table_is_found(tmp_path):
    """What astropy wrote comes back with its header, behind an empty primary and a table."""
    table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))])
    drawn = fits.ImageHDU(np.arange(12, dtype=">i2").reshape(3, 4))
    drawn.header["PUPLSCAL"] = 0.125
    fits.HDUList([fits.PrimaryHDU(), table, drawn]).writeto(tmp_path / "map.fits")

    image, header = first_image(tmp_path / "map.fits")

    assert image.dtype == np.float64
    np.testing.assert_array_equal(image, drawn.data)
    assert header["PUPLSCAL"] == 0.125


@pytest.mark.parametrize("content", [None, b"", b"SIMPLE", b"no FITS at all" * 400])
def test_what_is_no_fits_file_says_so(tmp_path, content):
    if content is not None:
        (tmp_path / "map.fits").write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read: "):
        first_image(tmp_path / "map.fits")


def test_file_without_image_says_so(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "map.fits")
    with pytest.raises(ValueError, match="holds no image"):
        first_image(tmp_path / "map.fits")


# A limit of time; truth is the clock of the test, with room for a busy machine.


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


# Worker processes and what they leave behind.


SCRIPT = """
    import sys, time
    from tqdm import tqdm
    from irlos_pipe.files.processes import in_processes

    def work(path):
        list(tqdm([1], disable=True))
        open(path, "w").close()
        time.sleep(60)

    if __name__ == "__main__":
        try:
            with in_processes(1, work, [(sys.argv[1],)]):
                while not __import__("os").path.exists(sys.argv[1]):
                    time.sleep(0.05)
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            print("interrupted")
"""


def test_a_worker_with_a_progress_bar_that_is_killed_leaves_nothing_behind(tmp_path):
    """No semaphore of the system, of which Python would warn at its end."""
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(SCRIPT))
    done = subprocess.run(
        [sys.executable, script, tmp_path / "begun"], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


# Workers that are forked.


def test_forked_workers_return_in_order_and_report_every_item():
    done = []
    found = forked_map(2, lambda item: (item, os.getpid()), range(7), done.append)
    assert [item for item, _ in found] == list(range(7))
    assert sorted(done) == list(range(7))
    assert os.getpid() not in {pid for _, pid in found}


def test_an_error_of_a_forked_worker_is_the_callers_and_ends_all():
    def work(item):
        if item == 1:
            raise InputDataError("cube.fits: no frames")
        time.sleep(0.01 if item == 0 else 60)

    began = time.monotonic()
    with pytest.raises(InputDataError, match=r"cube\.fits: no frames"):
        forked_map(3, work, range(6))
    assert time.monotonic() - began < 30
    assert not multiprocessing.active_children()


def test_what_a_killed_worker_had_to_do_is_done_by_the_caller(caplog):
    caller = os.getpid()

    def work(item):
        if item == 2 and os.getpid() != caller:
            os.kill(os.getpid(), signal.SIGKILL)
        return item**2

    assert forked_map(2, work, range(5)) == [0, 1, 4, 9, 16]
    assert "a worker process was killed" in caplog.text


@pytest.mark.parametrize("processes", [1, 2])
def test_the_caller_has_work_of_its_own_meanwhile(processes):
    caller, here = os.getpid(), []
    found = forked_map(processes, lambda _: os.getpid(), [0], meanwhile=lambda: here.append(os.getpid()))
    assert here == [caller]
    assert (found == [caller]) == (processes == 1)


FORKING = """
    import os, sys, time
    from pathlib import Path
    from irlos_pipe.files.processes import forked_map

    def work(item):
        Path(sys.argv[1], str(os.getpid())).touch()
        time.sleep(60)

    forked_map(2, work, range(4))
"""


def test_forked_workers_end_with_a_caller_that_is_killed(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(FORKING), tmp_path])
    deadline = time.monotonic() + 30
    while len(pids := [int(one.name) for one in tmp_path.iterdir()]) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert len(pids) == 2
    while any(map(running, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(running, pids))


def running(pid):
    """Whether a process is there, and no zombie."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"
