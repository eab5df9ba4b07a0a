"""What goes wrong in the simulated telescope of the focus loop. Truth: counters by hand; frozen exposures."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import focus_loop as made_loop

from benchmarks.focus_faults import rig as faults
from benchmarks.focus_faults.spoiling import PIXELS
from benchmarks.focus_loop.process import Feed
from benchmarks.focus_loop.telescope import Exposed, Night
from irlos_pipe.control.exposures import Read

READS = 3


class _Ring:
    """Keeps what is written: counters, and whether damaged."""

    def __init__(self):
        self.written: list[Read] = []
        self.damaged: list[int] = []

    def write(self, read: Read, *, damaged: bool = False) -> None:
        self.written.append(read)
        if damaged:
            self.damaged.append(read.counter)


def delivered(fault: str) -> _Ring:
    """Two exposures of three reads, of which the first has a `fault`."""
    ring, night = _Ring(), Night(reads=READS, exposures=2, faults={fault: [(0, 0)]})
    silent = SimpleNamespace(read=lambda: None)
    feed = Feed(SimpleNamespace(night=night), ring, silent, Path("truth"), 0.0)
    for index in range(2):
        reads = [Read(READS * index + one, 0.0, np.ones((2, 2))) for one in range(READS)]
        feed._deliver(index, Exposed(reads, 0.0, 0.0))
    return ring


@pytest.mark.parametrize(
    ("fault", "counters"),
    [
        ("none", [0, 1, 2, 3, 4, 5]),
        ("late", [0, 1, 3, 2, 4, 5]),
        ("missing", [1, 2, 3, 4, 5]),
        ("swapped", [2, 1, 0, 3, 4, 5]),
        ("doubled", [0, 0, 1, 1, 2, 2, 3, 4, 5]),
        ("nan", [0, 1, 2, 3, 4, 5]),
        ("damaged", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_a_fault_reaches_the_reads_of_its_exposure_alone(fault, counters):
    ring = delivered(fault)
    assert [read.counter for read in ring.written] == counters
    assert ring.damaged == ([1] if fault == "damaged" else [])
    spoilt = [read.counter for read in ring.written if np.isnan(read.image_e).any()]
    assert spoilt == ([0] if fault == "nan" else [])


# -- bad exposures -----------------------------------------------------------------------------


class FewSkies(faults.Skies):
    """Images of the loop's own model in place of the sky."""

    def exposure_e(self, look, mag_j, defocus_nm, rng):
        return made_loop.image_e(defocus_nm, int(rng.integers(1 << 30)), flux_e=1e6).clip(0), defocus_nm


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "used"), [(None, 30), (PIXELS["frozen"], 24)], ids=["right", "frozen"])
def test_the_rig_closes_the_loop_and_a_spell_of_bad_exposures_is_not_used(tmp_path, spoil, used):
    spell = 0 if spoil is None else 6
    skies = FewSkies(tmp_path, 1)
    rig = faults.Rig(skies, 8.0, 3, before=20, spell=spell, after=10 - spell, spoil=spoil)
    found = faults.run(rig, made_loop.calibration(), tmp_path / "loop")
    assert sum(one["valid"] for one in found.records) == used
    assert abs(found.shots[-1].defocus_nm) < 40.0
