"""Images in memory: right numbers from an array of a telescope that nobody described in files."""

import gc
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.units import um
from helpers import own_camera
from helpers.paths import REPOSITORY

import irlos_pipe as irlos
from irlos_pipe.api.reducing import prepared
from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.recipe import load_recipe

EXAMPLE = re.search(r"```python\n(import numpy.*?)```", (REPOSITORY / "docs/api.md").read_text(), re.DOTALL)[
    1
]
NOLLS = range(4, 31)
PUPIL = {
    "diameter_m": own_camera.DIAMETER_M,
    "obscuration": own_camera.OBSCURATION,
    "vanes": {"angles_deg": own_camera.VANES_DEG, "width_m": own_camera.VANE_M},
}
CAMERA = {"pixel_scale_mas": 20.0, "wavelength_nm": 1600, "diversity": {6: 150.0}, "pupil": PUPIL}
IMAGES = np.random.default_rng(1).poisson(9.0, (4, 24, 24))  # for what is refused before it is looked at


def ncpa_nm() -> dict[int, float]:
    """Noll 4 to 30, 100 nm in all."""
    values = np.random.default_rng(7).normal(size=len(NOLLS)) * np.exp(-0.1 * np.arange(len(NOLLS)))
    return dict(zip(NOLLS, (100 * values / np.linalg.norm(values)).tolist(), strict=True))


def with_diversity(noll: int, nm: float) -> dict[int, float]:
    """The NCPAs and what is put in on purpose."""
    return ncpa_nm() | {noll: ncpa_nm()[noll] + nm}


def require_right(result: irlos.Reduction) -> None:
    """The error is what is quoted, as far as one draw of 27 modes says, and small beside 100 nm."""
    found, sigma = (result.results[key] for key in ("zernike_nm", "sigma_nm"))
    error_nm = np.array([found[str(noll)] - nm for noll, nm in ncpa_nm().items()])
    quoted_nm = np.array([sigma[str(noll)] for noll in NOLLS])
    assert 0.4 < np.sqrt(np.mean((error_nm / quoted_nm) ** 2)) < 1.7
    assert np.linalg.norm(quoted_nm) < 5 and np.linalg.norm(error_nm) < 5
    assert [check.name for check in result.run.checks if not check.passed] == []


@pytest.mark.slow
def test_the_example_of_the_docs_finds_the_ncpas_within_their_errors_and_draws_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("star.npy", own_camera.frames(with_diversity(6, 150.0)))
    found: dict = {}
    exec(EXAMPLE, found)
    require_right(found["result"])
    assert len(found["ncpa"]) > 100 and found["figure"].axes
    figure, places = plt.subplots(2, 3)
    names = ("modes", "image", "model", "residual", "profile", "wavefront")
    for axes, name in zip(places.flat, names, strict=True):
        assert getattr(found["result"], f"plot_{name}")(axes) is figure and axes.has_data()
    plt.close(figure)
    with pytest.raises(ConfigurationError, match="several axes"):
        found["result"].run.figure("cal-time", places[0, 0])
    with pytest.raises(ConfigurationError, match="did you mean 'cal-time'"):
        found["result"].run.figure("cal-tim")
    with pytest.raises(AttributeError, match="lift"):
        found["result"].plot_ramp()


@pytest.mark.slow
def test_planes_and_bands_are_fitted_together_whatever_way_the_pupil_is_given():
    settings = {"highest_noll": 36, "correct": {"highest_noll": 34}}
    turned, defocused = (own_camera.frames(with_diversity(*one), 8) for one in ((6, 150.0), (4, 200.0)))
    planes = CAMERA | {"diversity": [{6: 150.0}, {4: 200.0}]}
    result = irlos.calibrate([turned, defocused], **planes, **settings)
    require_right(result)
    offsets, (noll, nm) = result.run["correct"], (result[key].value for key in ("noll", "zernike_nm"))
    assert offsets["noll"].value.tolist() == list(range(2, 35))
    np.testing.assert_allclose(offsets["offset_nm"].value, -nm[noll <= 34])
    near, far = (
        own_camera.frames(with_diversity(6, 150.0), 8, nm=wavelength) for wavelength in (1600.0, 2150.0)
    )
    bands = CAMERA | {"pupil": own_camera.pupil(), "diameter_m": own_camera.DIAMETER_M}
    require_right(irlos.calibrate(near, {"images": far, "wavelength_nm": 2150}, **bands, **settings))


@pytest.mark.slow
def test_an_array_gives_to_the_bit_what_its_file_gives_and_a_folder_keeps_all_that_a_run_leaves(tmp_path):
    images = own_camera.frames(with_diversity(6, 150.0), 6, 32)
    few = {"highest_noll": 8, "effects": []}
    memory = irlos.calibrate(images, **CAMERA, **few)
    kept = irlos.calibrate(list(images), **CAMERA, **few, output=tmp_path / "kept")
    from_file = irlos.calibrate(
        tmp_path / "kept/.images/calibration.fits",
        settings={"instrument": str(tmp_path / "kept/.images/pupil.yaml"), "model.effects": []},
        highest_noll=8,
    )
    for other in (kept, from_file):
        np.testing.assert_array_equal(memory["zernike_nm"].value, other["zernike_nm"].value)
    assert (tmp_path / "kept/report.html").is_file() and memory.config["highest_noll"] == 8
    irlos.calibrate(images, **CAMERA, **few, output=tmp_path / "kept")
    assert "calibrate: up to date" in (tmp_path / "kept/run.log").read_text()
    folder = memory.run.path
    assert folder.is_dir() and memory.run["ingest"].stage == "ingest"
    del memory
    gc.collect()
    assert not folder.exists()


@pytest.mark.slow
def test_a_ramp_in_memory_is_measured_with_its_calibration():
    images = own_camera.frames(with_diversity(6, 150.0), 8)
    steps_nm = np.arange(-120.0, 121.0, 60.0)
    ramp = [
        own_camera.frames(with_diversity(6, 150.0) | {4: ncpa_nm()[4] + step}, 2, seed=number + 3)
        for number, step in enumerate(steps_nm)
    ]
    fast = {"calibrate": {"highest_noll": 36}, "compare": False}
    lamp = {"images": np.ma.masked_greater(images, 1e9), "target": "lamp"}
    result = irlos.lift(ramp, lamp, introduced_defocus_nm=steps_nm, **CAMERA, **fast)
    error_nm = result["defocus_nm"].value - np.repeat(steps_nm, 2)
    assert np.abs(error_nm).max() < 3 and result.results["summary"]["slope"] == pytest.approx(1, abs=0.02)
    assert len(result.plot_ramp().axes) == 2


def test_a_list_of_frames_is_one_recording_and_keys_reach_side_cars_and_settings(tmp_path):
    given = {
        "wavelength_nm": {1588: 1, 1612: 2}, "e_per_adu": np.float32(2.5), "diversity": {np.int64(5): 9},
        "pupil": "vlt", "highest_noll": 44, "ingest": {"min_star_snr": 5}, "seeing_arcsec": 0.8,
    } | {"pixel_scale_mas": 9.7}  # fmt: skip
    star = own_camera.frames({}, 4, 24)[:, 2:]
    paths, settings, _ = prepared("calibrate", {"calibration": list(star)}, given, tmp_path / "a")
    assert paths == [f"calibration={tmp_path}/a/calibration.fits"]
    recipe = load_recipe("ncpa_calibration", settings, paths)
    assert recipe.configs["calibrate"].highest_noll == 44 and recipe.configs["ingest"].min_star_snr == 5
    assert recipe.instrument.pupil == irlos.load_instrument("irlos").pupil
    (recording,) = irlos.read_recordings(tmp_path / "a", recipe.instrument)
    told = recording.acquisition
    assert recording.images_e.shape == (4, 22, 24) and told.spectrum == ((1588, 1), (1612, 2))
    assert (told.diversity, told.detector.e_per_adu, told.seeing_arcsec) == ({5: 9}, 2.5, 0.8)


@pytest.mark.parametrize(
    ("images", "changed", "message"),
    [
        (IMAGES * np.nan, {}, "calibration: no pixel has a finite value"),
        (IMAGES * 0, {}, "^calibration: none of the 4 frames can be used"),
        ([], {}, "no images"),
        ({"image": IMAGES}, {}, "unknown key 'image'; did you mean 'images'"),
        (IMAGES, {"pixel_scale_mas": 0.02}, "0.02 is 0.00025 λ/D at 1600 nm and 4.2 m.*check the units"),
        (IMAGES, {"wavelength_nm": "1600", "pixel_scale_mas": "0.02"}, "0.02 is 0.00025 λ/D at 1600 nm"),
        (IMAGES, {"diversity": {6: -0.17 * um}}, r"^-0\.17 um: give plain numbers"),
        (IMAGES, {"diversity": None}, "diversity is missing: what was introduced"),
        (IMAGES, {"pupil": None}, "pupil is missing: 'circle' or an array with diameter_m"),
        (IMAGES, {"pupil": np.ones((20, 30)), "diameter_m": 4.2}, r"^pupil: map: shape \(20, 30\) should be"),
        (IMAGES, {"pupil": PUPIL | {"diameter_m": 4200}}, "^pupil: fact 'pupil_diameter_m' = 4200.0 should"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_without_the_name_of_a_file(images, changed, message):
    about_keywords = changed or isinstance(images, list) or (isinstance(images, dict) and "image" in images)
    with pytest.raises(ConfigurationError if about_keywords else InputDataError, match=message) as problem:
        irlos.calibrate(images, **CAMERA | changed)
    assert len(str(problem.value).splitlines()) == 1 and "/tmp" not in str(problem.value)
