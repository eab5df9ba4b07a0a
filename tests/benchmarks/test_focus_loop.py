"""The simulated telescope of the focus loop, what goes wrong in it, and how nights and faults are scored.

Truth: nights written down by hand, counts made by hand; right and frozen exposures.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import focus_loop as made_loop

from benchmarks.focus_faults import rig as faults
from benchmarks.focus_faults.spoiling import PIXELS
from benchmarks.focus_loop.process import Feed
from benchmarks.focus_loop.run import Outcome
from benchmarks.focus_loop.telescope import FIRST_COUNTER, Exposed, Night, Telescope
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


@pytest.fixture
def telescope(tmp_path) -> Telescope:
    """A star whose pixels all have 1000 e-, at any defocus: its light needs no simulation."""
    rows = np.full((1, 1, 64, 64), 1000.0, np.float32)
    np.savez(tmp_path / "calm.npz", series_e=rows, sky_focus_nm=np.zeros(1))
    return Telescope(Night(reads=2, exposures=6, start_nm=300.0, faults={"lost": [(2, 2)]}), tmp_path)


def test_an_offset_arrives_after_the_delay(telescope):
    """A delay of one: what follows from exposure 0 is taken off exposure 2."""
    residuals = []
    for index, answer in enumerate([100.0, 100.0, 100.0, 0.0]):
        exposed = telescope.expose(index)
        residuals.append(exposed.drift_nm - exposed.residual_nm)
        telescope.queue_nm.append(answer)
    assert residuals == pytest.approx([0.0, 0.0, 100.0, 100.0])


def outcome(records: list[dict], residuals_nm: list[float]) -> Outcome:
    truth = {i: {"exposure": i, "drift_nm": 0.0, "residual_nm": one} for i, one in enumerate(residuals_nm)}
    return Outcome(Night(reads=1, exposures=len(residuals_nm)), records, [], truth, [])


def record(number: int, offset_nm: float, valid: bool = True, commanded: bool = True) -> dict:
    exposure = FIRST_COUNTER + number
    return {
        "sequence": number + 1,
        "exposure": exposure,
        "valid": valid,
        "commanded": commanded,
        "offset_nm": offset_nm,
    }


def test_an_offset_from_a_measurement_that_is_not_valid_is_counted():
    held = [record(0, 1.0), record(1, 1.0, valid=False, commanded=False), record(2, 2.0)]
    moved = [record(0, 1.0), record(1, 5.0, valid=False, commanded=False), record(2, 5.0)]
    told = [record(0, 1.0), record(1, 1.0, valid=False, commanded=True), record(2, 1.0)]
    assert [outcome(one, [0.0] * 3).wrongly_commanded() for one in (held, moved, told)] == [0, 1, 1]


def test_exposures_without_a_record_and_gaps_in_the_sequence_are_seen():
    records = [record(0, 0.0), record(2, 0.0)]
    found = outcome(records, [0.0] * 3)
    assert found.lost() == {1}
    assert not found.sequence_is_whole()
    assert outcome([record(0, 0.0), record(1, 0.0)], [0.0] * 2).sequence_is_whole()


def test_closing_and_recovery_count_from_the_last_exposure_of_a_fault():
    found = outcome([], [500.0, 150.0, 90.0, 10.0, 80.0, 60.0, 30.0, 20.0, 10.0, 5.0])
    assert found.closed_at == 2
    assert found.recovery(4) == 2
    assert found.recovery(4, limit_nm=1.0) == -1


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
