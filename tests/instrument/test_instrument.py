"""Instrument profiles."""

import math
import re

import pytest
import yaml
from helpers.paths import REPOSITORY

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.instrument.profile import (
    FACTS,
    require_unit,
    unit_of_name,
)
from irlos_pipe.optics.pupil import petals_of, segments_of
from irlos_pipe.simulate.recordings.run import plan_simulation
from irlos_pipe.simulate.recordings.spec import load_spec


@pytest.fixture
def profile():
    return yaml.safe_load((PROFILES / "irlos.yaml").read_text())


def written(folder, content):
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


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
        (
            "facts.pupil_diameter_m.status",
            "adoptd",
            r"mine\.yaml:\d+: facts\.pupil_diameter_m\.0\.status = 'adoptd'.*did you mean 'adopted'",
        ),
        ("facts.photons_per_s_m15", GONE, "fact 'photons_per_s_m15' is missing"),
        ("facts.seeing_ratio_mass_dimm.value", -1, "seeing scale 'mass_dimm': ratio -1 should be positive"),
        ("facts.seeing_arcsec.since", "2020-01-02", "since 2020-01-02 is not before until 2020-01-01"),
        ("defaults.seeing_arcsec", "seing_arcsec", "no fact 'seing_arcsec'; did you mean 'seeing_arcsec'"),
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


# The example of docs/instruments.md works.


PAGE = REPOSITORY / "docs/instruments.md"


def test_the_example_is_the_telescope_that_the_page_describes(tmp_path):
    example = re.search(r"```yaml\n(name:.*?)```", PAGE.read_text(), re.DOTALL)[1]
    instrument = load_instrument(written(tmp_path, yaml.safe_load(example)))
    assert (petals_of(instrument.pupil).count, segments_of(instrument.pupil).count) == (3, 18)
    assert instrument.pupil.obstructions[0].placement.shift_m == pytest.approx((-1.1, 0.4))
    assert instrument.defaults["pixel_scale_mas"] == 17.6
    assert instrument.on("2021-01-01").defaults["pixel_scale_mas"] == 18.0


# Units of facts, as names ask for them and as people write them.


@pytest.mark.parametrize(
    "path", sorted([*PROFILES.glob("*.yaml"), *REPOSITORY.glob("recipes/*/bead_*.yaml")])
)
def test_the_facts_of_a_profile_that_ships_have_the_units_of_their_names(path):
    facts = yaml.safe_load(path.read_text()).get("facts")
    if facts is None:
        pytest.skip("no profile")
    for name, entries in facts.items():
        for entry in entries if isinstance(entries, list) else [entries]:
            if unit := FACTS[name].unit if name in FACTS else unit_of_name(name):
                require_unit(name, entry["unit"], unit)


@pytest.mark.parametrize(
    ("fact", "unit", "wanted"),
    [
        ("pupil_diameter_m", "mm", "m"),
        ("ao_residual_nm_per_arcsec", "nm", "nm/arcsec"),
        ("apd_gain_high", "e-/ADU", "1"),
    ],
)
def test_a_unit_that_contradicts_the_name_is_told_in_one_line(tmp_path, profile, fact, unit, wanted):
    entries = profile["facts"][fact]
    (entries[-1] if isinstance(entries, list) else entries)["unit"] = unit
    with pytest.raises(ConfigurationError) as caught:
        load_instrument(written(tmp_path, profile))
    assert f"fact '{fact}' should be in {wanted}, but its unit is '{unit}'" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1 and "mine.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("wanted", "spellings"),
    [
        ("m", ["m", "metres", " Meter "]),
        ("1/m", ["1/m", "m^-1", "m-1", "/m", "cycles/m", "1 per m", "per m"]),
        ("1/s", ["1/s", "Hz", "photons/s", "photons per second"]),
        ("e-/ADU", ["e-/ADU", "e/adu", "electrons per count", "e-/DN"]),
        ("e-", ["e-", "e", "electrons", "e- rms", "e-/px"]),
        ("e-/s", ["e-/s", "e-/s/px", "e-/pixel/s", "electrons per second"]),
        ("nm/arcsec", ["nm/arcsec", 'nm/"', "nm per arcsec"]),
        ("arcsec", ["arcsec", "″", "arcseconds"]),
        ("1", ["1", "", "-", "dimensionless"]),
        ("C", ["C", "°C", "deg C", "Celsius"]),
        ("Hz, 1, 1", ["Hz and pure numbers", "Hz, 1, 1", "Hz"]),
    ],
)
def test_a_unit_may_be_written_in_the_usual_ways(wanted, spellings):
    for unit in spellings:
        require_unit("a fact", unit, wanted)
