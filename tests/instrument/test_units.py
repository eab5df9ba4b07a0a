"""Units of facts, as names ask for them and as people write them."""

from __future__ import annotations

import pytest
import yaml
from helpers.paths import REPOSITORY

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.instrument.profile import FACTS, require_unit, unit_of_name


@pytest.fixture
def profile():
    return yaml.safe_load((PROFILES / "irlos.yaml").read_text())


def loaded(folder, profile):
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(profile))
    return load_instrument(path)


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
        ("pupil_vanes_m", "cm", "m"),
        ("ao_cutoff_per_m", "m", "1/m"),
        ("ao_cutoff_per_m", "1/mm", "1/m"),
        ("ncpa_amplitude_nm", "um", "nm"),
        ("ao_residual_nm_per_arcsec", "nm", "nm/arcsec"),
        ("seeing_arcsec", "mas", "arcsec"),
        ("photons_per_s_m15", "1/min", "1/s"),
        ("pixel_scale_full_pupil_mas", "arcsec", "mas"),
        ("amplifier_e_per_adu", "ADU/e-", "e-/ADU"),
        ("read_exposure_s", "ms", "s"),
        ("dark_current_e_per_s", "e-/h", "e-/s"),
        ("recorder_rate_hz", "kHz", "Hz"),
        ("site_pressure_hpa", "Pa", "hPa"),
        ("site_temperature_c", "K", "C"),
        ("vibration_lines", "1/min, 1, 1", "Hz, 1, 1"),
        ("apd_gain_high", "e-/ADU", "1"),
    ],
)
def test_a_unit_that_contradicts_the_name_is_told_in_one_line(tmp_path, profile, fact, unit, wanted):
    entries = profile["facts"][fact]
    (entries[-1] if isinstance(entries, list) else entries)["unit"] = unit
    with pytest.raises(ConfigurationError) as caught:
        loaded(tmp_path, profile)
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
