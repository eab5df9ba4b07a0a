"""How complete a diagnosis is, from what its names leave. Truth: analysis."""

from types import SimpleNamespace

import pytest

from irlos_pipe.diagnosis.acceptance import Search
from irlos_pipe.diagnosis.checks import PHOTONS, SPECKLES
from irlos_pipe.diagnosis.grade import (
    copies_in_a_row,
    judged,
    one_place_twice,
    without_ordinary_facts,
)
from irlos_pipe.diagnosis.null_model import Excess
from irlos_pipe.diagnosis.records import Gap, NoiseVerdict, Options
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.pupil_places import PhaseBump, PupilSpot

SURE, FLOOR = 5.0, 0.03


def model(chi2: float, *names: str) -> SimpleNamespace:
    """A model with an excess χ² over one of noise of 1000, which says the same beside other variances."""
    fitted = SimpleNamespace(effects=[SimpleNamespace(name=name) for name in names])
    stack = SimpleNamespace(photon_limited=True, limited_by=lambda photons: None)
    stack.without_model_error = lambda: stack
    one = SimpleNamespace(excess=Excess(chi2, 45.0, 1000.0), fitted=fitted, stack=stack)
    one.under = lambda stack: one
    return one


def name(effect: str, ordinary: bool, closed: float = 0.9) -> SimpleNamespace:
    """An accepted name that closes a part of the gap without it."""
    base = SimpleNamespace(fact=effect == "plate_scale", copies_star=effect == "companion")
    of = {"base": base, "effect": SimpleNamespace(speckles=False), "gap": gap(closed)}
    return SimpleNamespace(name=effect, label=effect, ordinary=ordinary, **of)


def search(left: float, *names: SimpleNamespace) -> Search:
    """From an excess χ² of 5000 to what the names leave."""
    final = model(left, *(one.name for one in names))
    return Search(model(5000.0), final, None, [*names], [], [])


def gap(closed: float, before: float = 0.06) -> Gap:
    """Of names that close a part of what a model misses, which adds to noise in squares."""
    missed = before**2 - FLOOR**2
    return Gap(before, (FLOOR**2 + (1 - closed) * missed) ** 0.5, FLOOR)


@pytest.fixture
def graded(monkeypatch):
    """Judge a search by the noise of its frames and the gap, where no name is in the place of another."""
    for what, answer in (("share_at_its_place", 1.0), ("copies_in_a_row", 0), ("one_place_twice", "")):
        monkeypatch.setattr(f"irlos_pipe.diagnosis.grade.{what}", lambda *_, answer=answer: answer)
    options = Options(30, held_out=0.25, most_names=4, sure=SURE)
    fine = SimpleNamespace(significance=0.0, ratio=1.0)
    return lambda found, kind, gap: judged(found, NoiseVerdict(kind, 1.0, 1.0), fine, gap, options)


@pytest.mark.parametrize("closed", [0.0, 0.4, 1.0])
def test_of_squares_noise_and_what_is_missing_add(closed):
    assert gap(closed).closed == pytest.approx(closed)


def test_what_any_instrument_has_is_adjusted_and_not_named_where_something_is_left():
    believed = without_ordinary_facts(search(900.0, name("plate_scale", True), name("companion", True)))
    assert [one.name for one in believed.accepted] == ["companion"]
    assert believed.adjusted == ["plate_scale"]
    assert believed.nearest is None


@pytest.mark.parametrize(
    ("kind", "found", "grade"),
    [
        (PHOTONS, gap(0.9), "unknown"),  # noise is known: something else is there
        (SPECKLES, gap(0.9), "partial"),  # some χ² is always left on sky
        (SPECKLES, gap(0.3), "unknown"),
    ],
)
def test_where_only_the_usual_is_found_and_much_is_left_the_cause_is_unknown(graded, kind, found, grade):
    one = name("plate_scale", True)
    judgement = graded(search(900.0, one), kind, found)
    assert judgement.grade == grade
    if grade == "unknown":
        assert judgement.search.nearest is one
        assert "plate_scale" in judgement.why_unknown


@pytest.mark.parametrize(
    ("kind", "left", "believed"),
    [
        (SPECKLES, 900.0, ["vibration", "companion"]),  # a copy of the star has a place of its own
        (SPECKLES, 0.0, ["vibration", "companion", "seeing_halo"]),
        (PHOTONS, 900.0, ["vibration", "companion", "seeing_halo"]),  # noise is known
    ],
)
def test_on_sky_a_name_that_closes_little_by_itself_is_adjusted_where_much_is_left(
    graded, kind, left, believed
):
    names = [name("vibration", False), name("companion", False, 0.1), name("seeing_halo", False, 0.3)]
    found = graded(search(left, *names), kind, gap(0.9)).search
    assert [one.name for one in found.accepted] == believed
    assert [*found.adjusted] == [one.name for one in names if one.name not in believed]


@pytest.mark.parametrize(("count", "grade"), [(2, "complete"), (3, "resembles")])
def test_three_places_of_the_pupil_stand_for_another_shape(graded, count, grade):
    names = [name("pupil_spot", False) for _ in range(count)]
    for one in names:
        one.base = PupilSpot()
    assert graded(search(0.0, *names), PHOTONS, gap(0.9)).grade == grade


@pytest.mark.parametrize(
    ("angles_deg", "number"),
    [((30, 31, 29), 3), ((30, 150, 270), 0), ((30, 31), 0), ((91, 269), 2), ((0, 90), 0)],
)
def test_too_many_copies_of_the_star_in_line_are_no_stars(angles_deg, number):
    effect = Companion()
    values = [effect.values_of(0.01, 40.0 * n, angle) for n, angle in enumerate(angles_deg, 1)]
    assert copies_in_a_row(fitted_with([FixedEffect(effect, one) for one in values])) == number


def fitted_with(effects: list[FixedEffect]) -> SimpleNamespace:
    """A model that has these effects."""
    known = {f"effect_{number}": one for number, one in enumerate(effects)}
    return SimpleNamespace(
        problem=SimpleNamespace(effects=SimpleNamespace(labels=[*known])),
        effect=known.get,
        values_of=lambda label: known[label].values,
    )


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ((PupilSpot, 2.0, 0.0, 0.4), (PupilSpot, 1.4, 0.9, 0.4), "pupil_spot"),  # 1.08 m apart
        ((PhaseBump, 2.0, 0.0, 0.3), (PhaseBump, 2.0, 0.0, 0.3), "phase_bump"),
        ((PupilSpot, 2.0, 0.0, 0.4), (PupilSpot, -2.0, 0.0, 0.4), ""),
        ((PupilSpot, 2.0, 0.0, 0.4), (PhaseBump, 2.0, 0.0, 0.4), ""),  # dirt that delays as well
    ],
)
def test_what_is_twice_in_one_place_of_the_pupil_has_another_shape(first, second, name):
    made = [FixedEffect(kind(), (0.5, x, y, width)) for kind, x, y, width in (first, second)]
    assert one_place_twice(fitted_with([FixedEffect(Companion(), (0.01, 50.0, 0.0)), *made])) == name
