"""Two processes with other seeds of Python's hashes write the same bits.

Truth: the other process. Sets and dictionaries of text come in another order where code relies on it.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.simulation_specs import CUBE, simulated, spec_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("hash") / "sim"
    simulated(
        folder,
        spec_of(
            {"cube": CUBE | {"window": [32, 32], "frames": 4, "mag_j": 7.0, "detector": {"e_per_adu": 2.0}}}
        ),
    )
    return folder / "data" / "cube"


def run(recording: Path, output: Path, seed: str) -> dict[str, bytes]:
    """Results, quality and recipe of the stage ingest in a process of its own."""
    command = [sys.executable, "-m", "irlos_pipe", "run", "ncpa_calibration", "--to", "ingest", "--jobs", "1"]
    inputs = ["--input", f"calibration={recording}", "--output", str(output)]
    done = subprocess.run(
        [*command, *inputs],
        env=os.environ | {"PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 4), done.stderr
    names = ("results.json", "qc.json", "recipe.resolved.yaml")
    return {name: (output / name).read_bytes() for name in names}


def without_times(content: bytes) -> bytes:
    """A time is the only number that may differ."""
    return b"\n".join(line for line in content.splitlines() if b'"seconds"' not in line)


def test_two_seeds_of_the_hashes_make_the_same_bits(recording, tmp_path):
    first, second = (run(recording, tmp_path / seed, seed) for seed in ("1", "2"))
    assert {name: without_times(one) for name, one in first.items()} == {
        name: without_times(one) for name, one in second.items()
    }
