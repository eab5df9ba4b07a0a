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


def test_a_lost_star_leaves_the_noise_alone_and_counters_go_on(telescope):
    kept, lost = telescope.expose(1), telescope.expose(2)
    assert np.mean(kept.reads[0].image_e) == pytest.approx(1000.0, rel=0.01)
    assert abs(np.mean(lost.reads[0].image_e)) < 20.0
    assert [read.counter - FIRST_COUNTER for read in (*kept.reads, *lost.reads)] == [2, 3, 4, 5]


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
    assert found.residual_nm(range(2)) == pytest.approx(np.sqrt(12.5 + wander))


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


def test_light_of_a_later_step_has_the_ncpas_of_its_middle(monkeypatch, tmp_path):
    made: dict[str, dict[int, float]] = {}

    def table(kept, scene, *size):
        made[kept.stem] = dict(scene().ncpa_nm)
        return kept.stem

    monkeypatch.setattr(telescopes, "kept_table", table)
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


# -- bad exposures -----------------------------------------------------------------------------


def measured(counter: int, defocus_nm: float, valid: bool = True) -> dict:
    return {"counter": counter, "defocus_nm": defocus_nm, "sigma_nm": 4.0, "valid": valid, "reasons": []}


def test_counts_are_those_of_the_exposures():
    """Right: used, refused, without a record. Bad: used and right, used and wrong, refused."""
    shots = [faults.Shot(number, 0.0, number <= 3) for number in range(1, 7)]
    records = [measured(1, 3.0), measured(2, 0.0, False), measured(4, -11.0), measured(5, 13.0)]
    found = faults.judged(faults.Outcome([*records, measured(6, 99.0, False)], [], shots))
    assert (found["bad"], found["right"], found["refused"]) == (3, 3, 2)
    assert (found["commanded_right"], found["commanded_wrongly"], found["wrong_right"]) == (1, 1, 0)


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
