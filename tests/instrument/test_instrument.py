"""Instrument profiles."""

import math

import pytest
import yaml

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import PROFILES, load_instrument


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


def test_adaptive_optics_and_laws_are_those_of_the_publications():
    facility = load_instrument("irlos").facility
    assert facility.photons_per_s_m15 == 150000
    assert (facility.cutoff_per_m, facility.outer_scale_m) == (2.5, 25.0)
    assert facility.residual_law.wfe_nm(0.5) == pytest.approx(110.7, abs=0.05)
    assert facility.ncpa_law.sigma_nm([2, 7]) == pytest.approx([80, 10 + 70 / math.e])


def test_values_that_changed_follow_the_date():
    mode = "20x20_SmallScale_500Hz_HighGain"
    irlos = load_instrument("irlos")
    assert irlos.modes[mode].pixel_scale_mas == 78
    assert irlos.on("2021-03-20").modes[mode].pixel_scale_mas == 78
    assert irlos.on("2021-03-19").modes[mode].pixel_scale_mas == 60


def test_a_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"gone\.yaml: cannot be read"):
        load_instrument(tmp_path / "gone.yaml")


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
