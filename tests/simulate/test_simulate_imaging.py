"""Static images of the simulator.

Truth: HCIPy on a pupil grid three to six times finer (independent code, `reference_psf`); HCIPy's Zernikes;
the model that is fitted to such images, which shares no optics with the simulator; energy.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from astropy.io import fits
from helpers.effect_cases import STRONG
from helpers.optics_cases import UT4, settings, vector
from helpers.reference_psf import hcipy, reference
from helpers.simulated_scenes import NCPA_NM, image, scene, worst

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, placed
from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Circle, Hexagons, Placement, Polygon, Samples
from irlos_pipe.effects import CATALOGUE, EffectSet, FixedEffect
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import LensletArray, apart, side_by_side
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.simulate.aperture import passed
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose, exposures
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.recordings.run import simulate
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings
from irlos_pipe.simulate.scene import Sampling
from irlos_pipe.simulate.telescope import zernike

pytestmark = pytest.mark.slow
SAMPLES = 768  # of HCIPy's pupil; those of the simulator are 256 and 128
TOTAL_NM = {**NCPA_NM, 6: NCPA_NM[6] - 170.0}


@pytest.mark.parametrize(("wavelength_nm", "window"), [(1200.0, (64, 64)), (1600.0, (33, 48))])
def test_static_images_agree_with_hcipy(wavelength_nm, window):
    found = image(bands=(Band(wavelength_nm, 1e-6),), window=window)
    assert worst(found, reference(SAMPLES).image(TOTAL_NM, wavelength_nm, window, 9.7)) < 1e-4


@pytest.mark.parametrize(("wavelength_nm", "window"), [(1200.0, (64, 64)), (1600.0, (33, 48))])
def test_the_coarser_sampling_of_sky_scenes_is_as_good(wavelength_nm, window):
    calm = {"sky": Sky(1e-4, wfe_nm=0.1), "motion": Motion(rms_mas=0.0), "window": window}
    assert scene(**calm).pupil_samples < scene().pupil_samples
    found = image(bands=(Band(wavelength_nm, 1e-6),), **calm)
    assert worst(found, reference(SAMPLES).image(TOTAL_NM, wavelength_nm, window, 9.7)) < 1e-4


def test_a_band_is_the_weighted_sum_of_its_wavelengths():
    bands = (Band(1215.0, 58.0, 0.5), Band(1625.0, 84.0, 0.5))
    nodes, weights = np.polynomial.legendre.leggauss(3)
    points = [
        (band.centre_nm + node * band.half_width_nm, weight / 2 * band.share)
        for band in bands
        for node, weight in zip(nodes, weights, strict=True)
    ]
    expected = sum(part * image(bands=(Band(nm, 1e-6),)) for nm, part in points)
    assert worst(image(bands=bands, sampling=Sampling(points_per_band=3)), expected) < 1e-4


def test_photons_follow_magnitude_exposure_and_throughput():
    faint = scene(mag_j=12.0, exposure_s=2.0, throughput=0.3, frame_rate_hz=0.5)
    assert np.isclose(faint.photons, 150_000 * 10**1.2 * 2 * 0.3)
    electrons = next(exposures(faint)).mean_e.sum()
    in_window = reference(SAMPLES).image(TOTAL_NM, 1600.0, (48, 48), 9.7).sum()
    assert np.isclose(electrons, faint.photons * in_window, rtol=1e-4)


def test_zernikes_agree_with_hcipy():
    grid = hcipy.make_pupil_grid(32, 2.0)  # no point at 0, where HCIPy divides by it
    for noll in (1, 2, 3, 4, 5, 6, 7, 10, 22, 37, 66):
        order = hcipy.noll_to_zernike(noll)
        expected = hcipy.zernike(*order, D=2.0, grid=grid, radial_cutoff=False)
        assert np.allclose(zernike(noll, grid.x, grid.y), expected, atol=1e-10), noll


def test_the_rotating_part_turns_with_the_derotator():
    parts = {"ncpa_nm": {7: 30.0}, "rotating_nm": {2: 50.0, 5: 20.0}}
    found = expose(scene(**parts, derotator_angle_deg=90.0)).mean_zernike_nm()
    expected = {3: 50.0, 5: -20.0, 7: 30.0}
    assert all(np.isclose(value, expected.get(noll, 0.0), atol=1e-6) for noll, value in found.items())


def test_the_truth_leaves_out_diversity_and_introduced_defocus():
    exposed = expose(scene(frames=2, introduced_nm=(100.0, -250.0)))
    fitted = dict(enumerate(exposed.telescope.fit_zernike_nm(exposed.mean_opd_nm, 52), start=2))
    for found in (fitted, exposed.mean_zernike_nm()):
        assert all(np.isclose(found[noll], NCPA_NM.get(noll, 0.0), atol=1e-6) for noll in found)
    assert np.allclose(exposed.zernike_nm, exposed.zernike_nm[0])
    assert worst(exposed.mean_e[0], exposed.mean_e[1]) > 0.1


# Simulated recordings of 2x2 modes: their files, and their images beside those of the model.
# Simulator and model share no optics, but the idea of what a lenslet array does: a sharp quarter of the pupil
# each, a common wavefront, no light between the field stops.


MODES_NM = {2: 30.0, 3: -20.0, 4: 90.0, 5: 25.0, 6: -40.0, 8: 30.0}
RECORDING = {
    "role": "psf",
    "mode": "20x20_SmallScale_500Hz_HighGain",
    "mag_j": 9,
    "bands": [{"centre_nm": 1600, "half_width_nm": 0}],
    "frames": 2,
    "exposure_s": 0.002,
    "window": [20, 20],
    "start": "2020-07-14T03:21:10",
    "ncpa": {"zernike_nm": MODES_NM},
    "sampling": {"pupil_samples": 96},
}


def spec(tmp_path, **changes):
    path = tmp_path / "spec.yaml"
    path.write_text(yaml_text({"simulation": "s", "recordings": {"one": RECORDING | changes}}))
    return load_spec(path)


def test_simulated_images_are_those_of_the_model(tmp_path):
    tilts = {"x_mas": [3.0, 0.0, 0.0, 0.0], "y_mas": [0.0, -2.0, 0.0, 0.0], "flux": [0.2, 0.0, 0.0, 0.0]}
    scene = plan_recordings(spec(tmp_path, lenslet_images=tilts))[0].scene
    image = expose(scene).mean_e[0] / scene.photons
    assert scene.pixel_scale_mas == 60.0  # the mode in 2020
    settings = PsfSettings(scene.geometry, (20, 20), 60.0, ((1600.0, 1.0),), KnownWavefront(), 96, lenslets=2)
    model = LensletArray(settings.for_broad_images(), tuple(MODES_NM), dtype=torch.float64)
    modes = torch.tensor([[*MODES_NM.values()]] * 3, dtype=torch.float64)
    modes[1, 0] += 3.0e-3 / 206265 * 8 * 1e9 / 4  # an angle θ is a tilt of θ D/4
    modes[2, 1] -= 2.0e-3 / 206265 * 8 * 1e9 / 4
    still, right, down = (apart(one) for one in model.images(modes))
    parts = [1.2 * right[0], down[1], still[2], still[3]]
    share = _light(scene.geometry)
    expected = side_by_side(parts).numpy() / (1 + 0.2 * share)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


def _light(geometry) -> float:
    """Share of the lower left quarter of the pupil, by counting points."""
    u = (np.arange(800) - 399.5) / 100
    clear = passed(geometry, u[None, :], u[:, None])
    return clear[:400, :400].sum() / clear.sum()


def test_a_raw_file_has_quadrants_with_borders_and_perhaps_no_side_car(tmp_path):
    simulate(spec(tmp_path, side_car=False), tmp_path / "out")
    (path,) = (tmp_path / "out" / "data" / "one").iterdir()
    assert path.name == "MUSE.2020-07-14T03:21:10.000.fits"
    with fits.open(path) as hdus:
        cube = hdus["SPARTA_TT_CUBE"].data
        assert hdus[0].header["ESO AOS MAIN MODES IRLOS"] == RECORDING["mode"]
    apart = cube.reshape(2, 2, 12, 2, 12)
    inside = apart[:, :, 1:-1, :, 1:-1]
    assert inside.min() > 100 and cube.sum(dtype=int) == inside.sum(dtype=int)


# Simulated images of pupils of other shapes against the model that is fitted to them (independent code).


SIX_VANES = tuple(
    Vane((0.0, 0.0), (4.2 * np.cos(a), 4.2 * np.sin(a)), 0.03) for a in np.deg2rad(np.arange(0, 360, 60))
)
SEGMENTED = PupilGeometry(8.0, 1.8, SIX_VANES, (Hexagons(1.1, 0.02, 3, (0, 22)),))
TRIANGLE = Polygon(((-2.5, -2.0), (3.0, -1.5), (0.5, 3.2)))
SHIFTED = placed(
    PupilGeometry(8.0, 1.0, SIX_VANES[:3], (TRIANGLE,), (Circle(0.5).placed(Placement(shift_m=(1.0, 0.2))),)),
    Placement.of(30.0, "y", (0.2, -0.1)),
)
U = grid_centres(200, 0.041)
MAP = PupilGeometry(
    8.2, aperture=(AmplitudeMap(Samples.of(area_weighted_pupil(replace(SHIFTED, diameter_m=8.2), U)), 0.041),)
)


def modelled(
    geometry=UT4, effect: str = "", pixel_scale_mas=9.7, spectrum=((1600.0, 1.0),), **public
) -> np.ndarray:
    nolls = tuple(NCPA_NM)
    case = settings(48, spectrum, geometry=geometry, pixel_scale_mas=pixel_scale_mas).for_broad_images()
    model = PsfModel(case, nolls, dtype=torch.float64)
    effects = []
    if effect:
        kind = CATALOGUE[effect]
        conditions = Conditions(model.settings, ResidualBand(1 / 8, 2.5, 25.0), None, 0.5, nolls[-1])
        made = kind.under(conditions, **kind.options_for(**public))
        effects = [FixedEffect(made, made.values_of(**public))]
    optics = EffectSet(effects, model.grids)()
    return model.images(vector(NCPA_NM, nolls), optics)[0].numpy()


# Those of the model are held against HCIPy in tests/effects.
STATIC = {name: STRONG[name] for name in (
    "atmospheric_dispersion", "plate_scale", "anamorphism", "diversity_error", "pupil_misregistration",
    "pupil_geometry", "amplitude_aberration", "pupil_spot", "low_wind_effect", "segment_piston",
    "high_order_ncpa", "phase_bump", "ncpa_drift", "chromatic_ncpa", "filter_ncpa", "companion", "ghost",
)} | {"spectrum": {"wavelength_nm": 1680.0, "slope": 0.5}}  # fmt: skip


@pytest.mark.parametrize("name", STATIC)
def test_an_effect_is_simulated_as_it_is_modelled(name):
    """In two colours; light of further images adds to that of the star."""
    spectrum, further = ((1500.0, 0.25), (1700.0, 0.75)), {"spectrum": {"width": 1.0}}
    truth = modelled(effect=name, spectrum=spectrum, **STATIC[name] | further.get(name, {}))
    truth *= 1 + STATIC[name].get("flux_ratio", 0.0)
    bands = tuple(Band(nm, 1e-6, share) for nm, share in spectrum)
    assert worst(image(bands=bands, effects={name: STATIC[name]}), truth) < 5e-5


@pytest.mark.parametrize(
    "geometry",
    [
        pytest.param(SEGMENTED, id="segmented", marks=pytest.mark.long),
        pytest.param(SHIFTED, id="polygon"),
        pytest.param(MAP, id="map", marks=pytest.mark.long),
    ],
)
def test_simulated_images_are_those_of_the_model_of_pupil_shapes(geometry):
    truth = modelled(geometry)
    assert np.abs(image(geometry=geometry) - truth).max() < 1e-4 * truth.max()


@pytest.mark.parametrize(
    ("effect", "public"),
    [
        (
            "low_wind_effect",
            {key: [30.0, -50.0, 80.0, -20.0, 10.0, -60.0] for key in ("piston_nm", "tip_nm")}
            | {"tilt_nm": [0.0] * 6},
        ),
        ("segment_piston", {"piston_nm": np.random.default_rng(1).normal(0, 80, 35).tolist()}),
    ],
    ids=["petals", "segments"],
)
def test_effects_of_pupil_parts_are_those_of_the_model(effect, public):
    truth = modelled(SEGMENTED, effect, **public)
    found = image(geometry=SEGMENTED, effects={effect: public})
    assert np.abs(found - truth).max() < 2e-4 * truth.max()


@pytest.mark.parametrize("name", ["pharo", pytest.param("nirc2_narrow", marks=pytest.mark.long), "bench"])
def test_the_pupils_of_profiles_are_simulated_as_they_are_modelled(name):
    instrument = load_instrument(name)
    scale = {"pixel_scale_mas": instrument.defaults["pixel_scale_mas"]}
    truth = modelled(instrument.pupil, **scale)
    assert np.abs(image(geometry=instrument.pupil, **scale) - truth).max() < 1e-4 * truth.max()
