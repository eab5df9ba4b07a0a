"""The simulated telescope of the focus loop, what goes wrong in it, and how a night is scored.

Truth: nights written down by hand.
"""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.focus_loop import telescope as telescopes
from benchmarks.focus_loop.ageing import Ageing
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


class _Mailbox:
    def read(self) -> None:
        return None


class _Stars:
    """Exposures of three reads, numbered from 0."""

    def __init__(self, night: Night):
        self.night = night

    def exposure(self, index: int) -> Exposed:
        reads = [Read(READS * index + one, 0.0, np.ones((2, 2))) for one in range(READS)]
        return Exposed(reads, 0.0, 0.0)


def delivered(fault: str) -> _Ring:
    """Two exposures, of which the first has a `fault`."""
    ring, stars = _Ring(), _Stars(Night(reads=READS, exposures=2, faults={fault: [(0, 0)]}))
    feed = Feed(stars, ring, _Mailbox(), Path("truth"), 0.0)
    for index in range(2):
        feed._deliver(index, stars.exposure(index))
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


def test_a_lost_star_leaves_the_noise_alone_and_counters_go_on(telescope):
    kept, lost = telescope.expose(1), telescope.expose(2)
    assert np.mean(kept.reads[0].image_e) == pytest.approx(1000.0, rel=0.01)
    assert abs(np.mean(lost.reads[0].image_e)) < 20.0
    assert [read.counter - FIRST_COUNTER for read in (*kept.reads, *lost.reads)] == [2, 3, 4, 5]


def test_the_same_night_again_is_the_same(telescope, tmp_path):
    again = Telescope(telescope.night, tmp_path)
    first, second = telescope.expose(3), again.expose(3)
    assert first.residual_nm == second.residual_nm
    assert np.array_equal(first.reads[0].image_e, second.reads[0].image_e)


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


def test_residuals_hold_what_wanders_within_an_exposure():
    """Drifts within a second add to the residual of an exposure: never less than the RMS of the truth."""
    found = outcome([], [3.0, 4.0])
    wander = found.night.drift.wander_within_nm2(1.0)
    assert wander > 0
    assert found.residual_nm(0, 2) == pytest.approx(np.sqrt(12.5 + wander))


def test_the_night_is_one_that_the_simulator_knows():
    night = Night(exposures=1)
    scene = telescopes.scene_of(night)
    assert (scene.mag_j, scene.exposure_s, scene.frames) == (12.0, 0.25, telescopes.SKY_READS)


def test_an_ageing_instrument_keeps_its_focus_and_the_size_of_what_turns():
    """A turn conserves the RMS of all modes of one order; steps of a drift add up to what is asked."""
    scene = telescopes.scene_of(Night(exposures=1))
    turned = Ageing(turn_deg=40.0, turning=1.0).aged(scene, 0.5, seed=1)
    assert [turned.ncpa_nm[noll] for noll in (2, 3, 4, 11)] == [scene.ncpa_nm[noll] for noll in (2, 3, 4, 11)]
    angle = np.deg2rad(2 * 20.0)
    before = scene.ncpa_nm[6] + 1j * scene.ncpa_nm[5]  # of cos 2θ and sin 2θ
    assert turned.ncpa_nm[6] + 1j * turned.ncpa_nm[5] == pytest.approx(before * np.exp(1j * angle))
    sizes = [np.linalg.norm([one.ncpa_nm[noll] for noll in range(5, 16)]) for one in (scene, turned)]
    assert sizes[0] == pytest.approx(sizes[1])
    drift = Ageing(drift_nm=30.0)
    after = [drift.change_nm(scene, hours, seed=1) for hours in (0.25, 1.0)]
    assert np.linalg.norm(list(after[1].values())) == pytest.approx(30.0)
    assert after[0] == pytest.approx({noll: nm / 4 for noll, nm in after[1].items()})
    assert min(after[1]) == 5


def test_nothing_changes_without_ageing():
    scene = telescopes.scene_of(Night(exposures=1))
    assert Ageing().none
    assert Ageing().aged(scene, 1.0, seed=1).ncpa_nm == pytest.approx(dict(scene.ncpa_nm))
    assert not Ageing(drift_nm=1.0).none


def test_light_of_a_later_step_has_the_ncpas_of_its_middle(monkeypatch, tmp_path):
    made: dict[str, dict[int, float]] = {}

    def table(scene, kept, *size):
        made[kept.stem] = dict(scene.ncpa_nm)
        return kept.stem

    monkeypatch.setattr(telescopes, "_table", table)
    night = Night(reads=1, exposures=700, ageing=Ageing(drift_nm=36.0, step_s=300.0))
    telescope = Telescope(night, tmp_path)
    assert telescope._calm == ["calm", "calm_1", "calm_2"]
    scene = telescopes.scene_of(night)
    assert made["calm"] == dict(scene.ncpa_nm)
    assert made["calm_2"] == pytest.approx(night.ageing.aged(scene, 750 / 3600, night.seed).ncpa_nm)
    used = []
    monkeypatch.setattr(telescope, "_read", lambda index, one, table, *rest: used.append(table))
    for index in (0, 299, 300, 699):
        telescope.expose(index)
    assert used == ["calm", "calm", "calm_1", "calm_2"]
