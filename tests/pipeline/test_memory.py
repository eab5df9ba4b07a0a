"""Memory hardly grows with the number of frames. Truth: the size of a frame as float32, 4 bytes per pixel; a
copy of all frames in a step shows as one of it per frame, a copy in double precision as two.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import HELPERS, REPOSITORY

FEW, MANY = 500, 3000
FRAME_BYTES = 64 * 64 * 4
ALLOWED = {"ingest": 2.5, "prior": 0.5, "long_exposure": 0.5, "dip_global": 0.5}  # frames per further frame

# Blocks of this size are mapped, and go back to the system when they are freed; smaller ones may stay.
MAPPED_BYTES = 4 * 2**20

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory needs Linux"),
]


def rises(frames: int) -> dict[str, int]:
    case = HELPERS / "memory_case.py"
    paths = os.pathsep.join([str(REPOSITORY), str(HELPERS.parent)])
    malloc = {"MALLOC_MMAP_THRESHOLD_": str(MAPPED_BYTES), "MALLOC_ARENA_MAX": "1"}
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": paths} | malloc
    command = [sys.executable, str(case), str(frames)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def growth() -> dict[str, float]:
    """Memory per further frame, in frames."""
    few, many = rises(FEW), rises(MANY)
    return {name: (many[name] - few[name]) / (MANY - FEW) / FRAME_BYTES for name in few}


@pytest.mark.parametrize("step", ALLOWED)
def test_a_further_frame_takes_little_more_memory_than_its_own_pixels(growth, step):
    """Cleaning makes images from the counts, and another copy of them where cosmics are taken out."""
    assert growth[step] < ALLOWED[step]
