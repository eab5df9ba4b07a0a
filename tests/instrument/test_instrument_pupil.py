"""Pupils in instrument profiles, the profiles that ship, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from astropy.io import fits
from helpers.paths import SHARED

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.pupil_drawing import turned
from irlos_pipe.conventions.pupil_parts import Circle, Hexagons
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.instrument.profile import FACTS
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres, petals_of, segments_of

KECK_MAP = SHARED / "realdata/keck_nirc2/keck_pupil_open2_240px.fits"
STATED = {"source": "a test", "status": "assumed"}


@pytest.fixture
def profile():
    return yaml.safe_load((PROFILES / "bench.yaml").read_text())


def loaded(folder, profile, **pupil):
    """The profile with a section `pupil`."""
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(profile | ({"pupil": STATED | pupil} if pupil else {})))
    return load_instrument(path)


def map_file(folder, values, **header):
    hdu = fits.PrimaryHDU(values)
    hdu.header.update(header)
    hdu.writeto(folder / "pupil.fits", overwrite=True)
    return "pupil.fits"


@pytest.mark.parametrize(
    ("name", "petals", "segments", "diameter_m", "cutoff_per_m", "scale_mas"),
    [
        ("irlos", 4, 4, 8.0, 2.5, 9.7),
        ("pharo", 4, 4, 4.646, 6.3, 25.0),
        ("nirc2_narrow", 6, 36, 10.95, 0.889, 9.942),
        ("bench", 1, 1, 8.0, 2.5, 9.7),
    ],
)
def test_the_profiles_that_ship(name, petals, segments, diameter_m, cutoff_per_m, scale_mas):
    instrument = load_instrument(name)
    assert (petals_of(instrument.pupil).count, segments_of(instrument.pupil).count) == (petals, segments)
    assert instrument.pupil.diameter_m == diameter_m
    assert instrument.facility.cutoff_per_m == cutoff_per_m
    assert instrument.defaults["pixel_scale_mas"] == scale_mas


def test_the_clear_area_of_pharo_is_that_of_its_stop():
    u = grid_centres(1000, 0.005)
    clear = area_weighted_pupil(load_instrument("pharo").pupil, u).sum() * 0.005**2
    # an annulus less four bars between two concentric circles, whose ends are all but arcs
    ends_m = 2 * (np.sqrt(2.323**2 - 0.1245**2 / 3) - np.sqrt(1.1465**2 - 0.1245**2 / 3))
    assert clear == pytest.approx(np.pi / 4 * (4.646**2 - 2.293**2) - 2 * ends_m * 0.249, rel=1e-4)


@pytest.mark.skipif(not KECK_MAP.exists(), reason="the map of the Keck pupil is not part of the project")
def test_the_pupil_of_keck_is_that_of_a_published_map_in_its_orientation():
    measured = fits.getdata(KECK_MAP) > 0.5
    step_m = 10.95 / 240
    u = grid_centres(240, step_m) + step_m  # the map lies a sample towards the origin
    keck = replace(load_instrument("nirc2_narrow").pupil, vanes=())  # it has none

    def agreement(angle_deg):
        return float(np.mean((area_weighted_pupil(turned(keck, angle_deg), u) > 0.5) == measured))

    assert agreement(0.0) > 0.97
    assert agreement(0.0) > max(agreement(10.0), agreement(30.0)) + 0.02


def test_a_drawn_pupil_is_placed_as_a_whole(tmp_path, profile):
    parts = [{"hexagons": {"flat_to_flat_m": 1.2, "gap_m": 0.02, "rings": 2, "missing": [0, 7]}}]
    spot = [{"circle": {"diameter_m": 0.3, "centre_m": [1.0, 0.5]}}]
    vane = [{"start_m": [0, 0], "end_m": [4, 0], "width_m": 0.1}]
    pupil = loaded(
        tmp_path, profile, aperture=parts, obstructions=spot, vanes=vane, rotation_deg=90, flip="x"
    ).pupil
    assert isinstance(pupil.aperture[0], Hexagons) and pupil.aperture[0].missing == (0, 7)
    assert isinstance(pupil.obstructions[0], Circle)
    assert pupil.obstructions[0].placement.shift_m == pytest.approx((-0.5, -1.0))
    assert pupil.vanes[0].end_m == pytest.approx((0, -4))


def test_a_map_is_read_with_its_scale_from_profile_or_header(tmp_path, profile):
    values = np.zeros((80, 80))
    values[10:70, 15:60] = 1.0
    name = map_file(tmp_path, values, PUPLSCAL=0.08)
    assert loaded(tmp_path, profile, map={"file": name}).pupil.map.step_m == 0.08
    stated = loaded(tmp_path, profile, map={"file": name, "metres_per_sample": 0.09})
    assert stated.pupil.map.step_m == 0.09
    assert np.array_equal(stated.pupil.map.samples.values, values)
    assert stated == loaded(tmp_path, profile, map={"file": name, "metres_per_sample": 0.09})


def circle(diameter_m, x=0.0, y=0.0):
    return {"circle": {"diameter_m": diameter_m, "centre_m": [x, y]}}


def square(x, y, side_m=2.0):
    corners = [[0, 0], [side_m, 0], [side_m, side_m], [0, side_m]]
    return {"polygon": {"corners_m": corners, "centre_m": [x, y]}}


@pytest.mark.parametrize(
    ("pupil", "message"),
    [
        ({"apertur": []}, r"mine\.yaml:\d+: unknown key 'pupil\.apertur'; did you mean 'aperture'"),
        ({"aperture": [{"polygon": {"corners_m": [[0, 0], [1, 1]]}}]}, "three corners or more"),
        ({"aperture": [{"circle": {"diameter_m": 9}}]}, "circle reaches 4.5 m .* beyond half the diameter"),
        ({"vanes": [{"start_m": [5, 0], "end_m": [9, 0], "width_m": 0.1}]}, "vane 1 lies outside"),
        ({"map": {"file": "gone.fits"}}, "map gone.fits cannot be read"),
        ({"aperture": [circle(1.0)]}, "lets no light on its disc pass; compare aperture, hole, obstructions"),
        ({"aperture": [circle(0.1, 3.9)]}, "lets only 0.0002 of the light on its disc pass"),
        (
            {"aperture": [circle(2.2)]},
            "light ends 1.1 m from the axis, before 0.67 of half the diameter, 4 m",
        ),
        ({"aperture": [circle(6.0, -1), circle(6.0, 1)]}, "overlap: 0.41 of its area is covered twice"),
        ({"aperture": [square(-2, -1), square(-0.1, -1)]}, "overlap: 0.02[0-9] of its area is covered twice"),
    ],
)
def test_a_mistake_in_a_drawing_is_told_in_one_line(tmp_path, profile, pupil, message):
    changed(profile, pupil_obscuration_m=2.0)
    with pytest.raises(ConfigurationError, match=message) as caught:
        loaded(tmp_path, profile, **pupil)
    assert len(str(caught.value).splitlines()) == 1 and "mine.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("values", "header", "message"),
    [
        (np.ones((80, 80)), {}, "map pupil.fits has no scale; give map.metres_per_sample, or PUPLSCAL"),
        (np.full((80, 80), np.nan), {"PUPLSCAL": 0.05}, "should be numbers, not NaN or infinite"),
        (np.ones((80, 60)), {"PUPLSCAL": 0.05}, r"shape \(80, 60\) should be that of a square"),
        (np.ones((80, 80)), {"PUPLSCAL": 0.2}, "the map reaches 11.17 m from the axis, beyond half"),
        (-np.ones((80, 80)), {"PUPLSCAL": 0.05}, "smallest amplitude -1 should not be negative"),
        (np.full((80, 80), 7.0), {"PUPLSCAL": 0.05}, "largest amplitude 7 should not exceed 1"),
    ],
    ids=["no scale", "NaN", "not square", "too large", "negative", "too bright"],
)
def test_a_map_that_cannot_be_used_is_told_in_one_line(tmp_path, profile, values, header, message):
    name = map_file(tmp_path, values, **header)
    with pytest.raises(ConfigurationError, match=message) as caught:
        loaded(tmp_path, profile, map={"file": name})
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "aperture",
    [
        [square(-2, -2), square(0, -2), square(-2, 0), square(0, 0)],
        [circle(0.2, 3.5), circle(0.2, -2.0, 2.5), circle(0.2, -2.0, -2.5)],
        [{"hexagons": {"flat_to_flat_m": 1.2, "gap_m": 0.0, "rings": 2}}],
        [{"hexagons": {"flat_to_flat_m": 0.2, "gap_m": 0.0, "rings": 18}}],
    ],
    ids=["squares side by side", "an aperture mask", "hexagons", "a thousand hexagons"],
)
def test_parts_that_meet_or_are_few_and_small_are_accepted(tmp_path, profile, aperture):
    drawn = loaded(tmp_path, profile, aperture=aperture).pupil
    clear = area_weighted_pupil(drawn, grid_centres(400, 0.02))
    assert clear.max() == pytest.approx(1.0, abs=1e-9) and clear.any()


def changed(profile, **facts):
    for name, value in facts.items():
        unit = FACTS[name].unit if name in FACTS else "1/m"
        profile["facts"][name] = {"value": value, "unit": unit, "status": "assumed", "source": "a test"}


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"ao_cutof_per_m": 3.0}, "unknown fact 'ao_cutof_per_m'; did you mean 'ao_cutoff_per_m'"),
        ({"pupil_obscuration_m": 8.0}, "obscuration, 8 m, should be smaller than the diameter"),
        ({"pupil_vane_width_m": 0.1}, "'pupil_vanes_m' and 'pupil_vane_width_m' belong together"),
        ({"ao_cutoff_per_m": 0.1}, "0.8 cycles per pupil diameter"),
        ({"vibration_lines": [[5.0, 0.7, 0], [6.0, 0.7, 0]]}, "shares of one axis add up to more than 1"),
    ],
)
def test_facts_that_contradict_each_other_are_told_in_one_line(tmp_path, profile, facts, message):
    changed(profile, **facts)
    with pytest.raises(ConfigurationError, match=message) as caught:
        loaded(tmp_path, profile)
    assert len(str(caught.value).splitlines()) == 1
