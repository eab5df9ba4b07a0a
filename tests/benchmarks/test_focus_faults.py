"""The suite of bad exposures. Truth: counts made by hand, and right and frozen exposures of the simulator."""

import pytest
from helpers import focus_loop as made

from benchmarks.focus_faults.cases import all_cases
from benchmarks.focus_faults.files import file_cases, visitor_cases
from benchmarks.focus_faults.judging import judged
from benchmarks.focus_faults.rig import Outcome, Rig, Shot, run
from benchmarks.focus_faults.sky import Look, Skies
from benchmarks.focus_faults.spoiling import PIXELS


def test_there_are_two_hundred_cases_and_half_of_them_are_further_kinds():
    cases = all_cases()
    names = [case.name for case in cases] + [name for name, *_ in (*file_cases(), *visitor_cases())]
    assert len(names) == len(set(names)) >= 200
    assert sum(not case.known for case in cases) >= 100


def record(counter: int, defocus_nm: float, valid: bool = True) -> dict:
    return {"counter": counter, "defocus_nm": defocus_nm, "sigma_nm": 4.0, "valid": valid, "reasons": []}


def test_counts_are_those_of_the_exposures():
    shots = [
        Shot(1, 0.0, True),  # used
        Shot(2, 0.0, True),  # refused
        Shot(3, 0.0, True),  # without a record
        Shot(4, 0.0, False),  # bad, used, and right
        Shot(5, 0.0, False),  # bad, used, and wrong
        Shot(6, 0.0, False),  # bad and refused
    ]
    records = [
        record(1, 3.0),
        record(2, 0.0, False),
        record(4, -11.0),
        record(5, 13.0),
        record(6, 99.0, False),
    ]
    found = judged(Outcome(records, [], shots))
    assert (found["bad"], found["right"], found["refused"]) == (3, 3, 2)
    assert (found["commanded_right"], found["commanded_wrongly"], found["wrong_right"]) == (1, 1, 0)


class FewSkies(Skies):
    """Images of the loop's own model in place of the sky."""

    def exposure_e(self, look, mag_j, defocus_nm, rng, reads=4):
        return made.image_e(defocus_nm, int(rng.integers(1 << 30)), flux_e=1e6).clip(0), defocus_nm


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "used"), [(None, 30), (PIXELS["frozen"], 24)], ids=["right", "frozen"])
def test_the_rig_closes_the_loop_and_a_spell_of_bad_exposures_is_not_used(tmp_path, spoil, used):
    spell = 0 if spoil is None else 6
    rig = Rig(
        FewSkies(tmp_path, 1), 8.0, 3, before=20, spell=spell, after=30 - 20 - spell, spoil=spoil, look=Look()
    )
    outcome = run(rig, made.calibration(), tmp_path / "loop")
    assert sum(one["valid"] for one in outcome.records) == used
    assert abs(outcome.shots[-1].defocus_nm) < 40.0
