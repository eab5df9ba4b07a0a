"""Whatever ends a run, only whole products are left, and the next run goes on."""

import os
import resource
import signal
import subprocess
import sys

import pytest
from conftest import Bench, products
from helpers.paths import HELPERS, REPOSITORY

pytestmark = pytest.mark.slow

FAKE_CLI = HELPERS / "fake_stages.py"


def start(bench: Bench, **options) -> subprocess.Popen:
    """Start ``irlos run`` on the bench in a process of its own."""
    command = [sys.executable, FAKE_CLI, "run", bench.recipe, "--output", bench.output, "--device", "cpu"]
    paths = os.pathsep.join(
        [str(REPOSITORY), str(HELPERS.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
        **options,
    )


def test_a_process_that_is_killed_leaves_no_partial_product_and_the_next_run_goes_on(bench):
    bench.make("calibrate.slow")
    process = start(bench)
    assert process.stdout.readline() == "calibrate is running\n"
    process.kill()
    process.communicate()
    assert products(bench.output) == ["01_ingest.h5"]
    (bench.data / "calibrate.slow").unlink()
    assert bench.run().exit_code == 0 and len(products(bench.output)) == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_run_with_130_one_line_and_no_half_product(bench, number):
    bench.make("calibrate.slow")
    process = start(bench)
    process.stdout.readline()
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130 and products(bench.output) == ["01_ingest.h5"]
    assert [line for line in errors.splitlines() if "error" in line] == [
        "irlos: error: interrupted; finished products are kept, run the same command to continue"
    ]
    assert not list(bench.output.glob(".*.part"))


def test_two_processes_cannot_use_a_folder_at_once(bench):
    bench.make("calibrate.slow")
    process = start(bench)
    process.stdout.readline()
    try:
        assert bench.run().exit_code == 75
    finally:
        process.kill()
        process.communicate()


def test_a_disk_that_takes_no_more_leaves_no_partial_product(bench):
    limit = 4096  # bytes; recipe, log and checksums stay below, no HDF5 product does

    def no_large_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = start(bench, preexec_fn=no_large_files)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert errors.splitlines()[-1] == (
        f"irlos: error: {bench.output / '01_ingest.h5'}: cannot be written: File too large"
    )
    assert products(bench.output) == [] and not list(bench.output.glob(".*.part"))
