"""Instrument profiles."""

import math

import pytest
import yaml

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.simulate.recordings.run import plan_simulation
from irlos_pipe.simulate.recordings.spec import load_spec


@pytest.fixture
def profile():
    return yaml.safe_load((PROFILES / "irlos.yaml").read_text())


def written(folder, content):
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_pupil_is_that_of_ut4():
    pupil = load_instrument("irlos").pupil
    assert (pupil.diameter_m, pupil.obscuration_m) == (8.0, 1.116)
    assert {vane.width_m for vane in pupil.vanes} == {0.040}
    ends = {vane.end_m for vane in pupil.vanes}
    assert ends == {(4.2197, 0.0), (0.0, 4.2197), (-4.2197, 0.0), (0.0, -4.2197)}
    for vane in pupil.vanes:
        x, y = vane.start_m
        assert x == y
        assert math.hypot(x, y) == pytest.approx(0.4045 / math.cos(math.radians(39.5)), abs=1e-5)


def test_the_vanes_of_a_pair_enclose_101_degrees():
    first, second, *_ = load_instrument("irlos").pupil.vanes
    directions = [math.atan2(v.end_m[1] - v.start_m[1], v.end_m[0] - v.start_m[0]) for v in (first, second)]
    assert math.degrees(directions[1] - directions[0]) == pytest.approx(101, abs=0.1)


def test_adaptive_optics_and_laws_are_those_of_the_publications():
    facility = load_instrument("irlos").facility
    assert facility.photons_per_s_m15 == 150000
    assert (facility.cutoff_per_m, facility.outer_scale_m) == (2.5, 25.0)
    assert facility.residual_law.wfe_nm(0.5) == pytest.approx(110.7, abs=0.05)
    assert facility.ncpa_law.sigma_nm([2, 7]) == pytest.approx([80, 10 + 70 / math.e])


def test_the_vibration_lines_leave_most_of_the_variance_to_the_wander():
    lines = load_instrument("irlos").facility.vibration_lines
    assert [hz for hz, *_ in lines] == sorted(hz for hz, *_ in lines)
    assert all(0 < sum(line[axis] for line in lines) < 0.5 for axis in (1, 2))


def test_another_telescope_has_its_own_adaptive_optics(tmp_path, profile):
    profile["facts"]["ao_cutoff_per_m"]["value"] = 6.0
    profile["facts"]["ncpa_plateau_nm"]["value"] = 3.0
    del profile["facts"]["vibration_lines"]
    facility = load_instrument(written(tmp_path, profile)).facility
    assert (facility.cutoff_per_m, facility.ncpa_law.plateau_nm, facility.vibration_lines) == (6.0, 3.0, ())


def test_every_value_has_unit_source_and_status():
    facts = [fact for facts in load_instrument("irlos").facts.values() for fact in facts]
    assert len(facts) > 10
    assert all(fact.unit and fact.source and fact.status for fact in facts)


def test_values_that_changed_follow_the_date():
    mode = "20x20_SmallScale_500Hz_HighGain"
    irlos = load_instrument("irlos")
    assert irlos.modes[mode].pixel_scale_mas == 78
    assert irlos.on("2021-03-20").modes[mode].pixel_scale_mas == 78
    assert irlos.on("2021-03-19").modes[mode].pixel_scale_mas == 60


def test_the_avalanche_gain_divides_the_conversion_gain():
    mode = load_instrument("irlos").modes["64x64_FullPupil_200Hz_HighGain"]
    assert mode.e_per_adu == pytest.approx(9.8 / 68)
    assert (mode.lenslets, mode.frame_rate_hz) == (1, 200)


def test_an_unknown_name_gets_a_suggestion():
    with pytest.raises(ConfigurationError, match="unknown instrument 'irls'; did you mean 'irlos'"):
        load_instrument("irls")


def test_a_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"gone\.yaml: cannot be read"):
        load_instrument(tmp_path / "gone.yaml")


SKY = ["photons_per_s_m15", "ao_cutoff_per_m", "outer_scale_m", "ao_residual_nm_per_arcsec"]
SKY += ["ao_residual_floor_nm", "seeing_arcsec"]


def test_a_bench_states_no_sky_and_has_no_residual_and_no_magnitudes(tmp_path, profile):
    for name in SKY:
        del profile["facts"][name]
    del profile["defaults"]["seeing_arcsec"]
    bench = load_instrument(written(tmp_path, profile))
    assert bench.facility.residual_law.wfe_nm(1.0) == 0
    with pytest.raises(ConfigurationError, match="states no photons_per_s_m15, which mag_j needs"):
        plan_simulation(load_spec("bench", [f"instrument={tmp_path}/mine.yaml"]), tmp_path / "sim", False)
    profile["facts"]["seeing_arcsec"] = {"value": 1.0, "unit": "arcsec", "status": "assumed", "source": "x"}
    with pytest.raises(ConfigurationError, match="fact 'ao_cutoff_per_m' is missing"):
        load_instrument(written(tmp_path, profile))


GONE = object()


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("facts.pupil_diameter_m.unit", GONE, r"yaml:\d+: key 'facts\.pupil_diameter_m\.0\.unit' is missing"),
        (
            "facts.pupil_diameter_m.status",
            "adoptd",
            r"mine\.yaml:\d+: facts\.pupil_diameter_m\.0\.status = 'adoptd'.*did you mean 'adopted'",
        ),
        ("facts.photons_per_s_m15", GONE, "fact 'photons_per_s_m15' is missing"),
        ("facts.pupil_diameter_m.value", "eight", "fact 'pupil_diameter_m' = 'eight' should be a number"),
        ("facts.pupil_vanes_m.value", [[0, 1, 2]], r"should be a list of \[\[x, y\], \[x, y\]\]"),
        ("facts.vibration_lines.value", [[48.3, 0.1]], r"should be a list of \[Hz, share_x, share_y\]"),
        ("facts.seeing_ratio_mass_dimm.value", -1, "seeing scale 'mass_dimm': ratio -1 should be positive"),
        ("facts.seeing_arcsec.since", "2020-01-02", "since 2020-01-02 is not before until 2020-01-01"),
        ("facts.pixel_scale_small_mas", [], "fact 'pixel_scale_small_mas' has 0 values on the present day"),
        ("defaults.seeing_arcsec", "seing_arcsec", "no fact 'seing_arcsec'; did you mean 'seeing_arcsec'"),
        (
            "defaults.pixel_scale",
            "pixel_scale_mas",
            "side-car key 'pixel_scale'; did you mean",
        ),
    ],
)
def test_a_mistake_in_a_profile_is_told_with_the_file(tmp_path, profile, where, value, message):
    profile["facts"]["seeing_arcsec"]["until"] = "2020-01-01" if "since" in where else None
    *above, key = where.split(".")
    section = profile
    for name in above:
        section = section[name]
    section.pop(key) if value is GONE else section.update({key: value})
    with pytest.raises(ConfigurationError, match=message) as caught:
        load_instrument(written(tmp_path, profile))
    assert "mine.yaml" in str(caught.value)
