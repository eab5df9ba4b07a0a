"""Every effect of the catalogue that acts before the detector.

Truth: HCIPy on a finer pupil for what changes the pupil; equal scenes told in another way (a moved
image is a tilted wavefront, a shifted band is another band); areas and moments by analysis.
"""

import numpy as np
import pytest
from helpers.reference_psf import reference
from helpers.simulated_scenes import MAS_RAD, NCPA_NM, UT4, image, of_light, scene, tilt_nm_rms, worst
from scipy.ndimage import label
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects import EFFECTS
from irlos_pipe.simulate.effects.pupil import LowWindEffect
from irlos_pipe.simulate.exposure import expose, telescope_of, with_effective_sky
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Sampling

CONTRACT = """
    tip_tilt_jitter vibration seeing_halo uneven_residual atmospheric_dispersion chromatic_ncpa filter_ncpa
    spectrum plate_scale anamorphism diversity_error pupil_misregistration pupil_geometry amplitude_aberration
    pupil_spot low_wind_effect segment_piston high_order_ncpa phase_bump ncpa_drift companion ghost
    interpixel_crosstalk detector_nonlinearity background_gradient bad_pixels focus_stage_hysteresis
    focus_stage_offset focus_stage_scale high_aperture correlated_noise
"""
SAMPLES = 512  # of HCIPy's pupil
TOTAL_NM = {**NCPA_NM, 6: NCPA_NM[6] - 170.0}
PETALS = {"piston_nm": [70, -70, 50, -30], "tip_nm": [0, 20, 0, -20], "tilt_nm": [25, 0, -25, 0]}


def moved(x_mas: float, y_mas: float, **changes) -> np.ndarray:
    """Image moved by tilting the wavefront."""
    tilted = dict(NCPA_NM)
    tilted[2] += tilt_nm_rms(x_mas)
    tilted[3] += tilt_nm_rms(y_mas)
    return image(**{"ncpa_nm": tilted} | changes)


def test_the_catalogue_is_that_of_the_contract():
    assert set(EFFECTS) == set(CONTRACT.split())


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"companions": {}}, "effects: 'companions' is not known; did you mean 'companion'"),
        ({"phase_bump": {"nm": 1.0, "x": 0.0}}, "effects.phase_bump: 'x' is not known; did you mean 'x_m'"),
        ({"companion": {"flux_ratio": 0.1}}, "effects.companion: pa_deg, sep_mas must be given"),
        ({"vibration": {"sigma_mas": 3.0, "shape": "gausian"}}, "did you mean 'gaussian'"),
        ({"low_wind_effect": {"piston_nm": [1.0]}}, "the pupil has 4 petals"),
        ({"spectrum": {"weights": [1.0, 2.0]}}, "has 2 factors; give one per band, 1"),
    ],
)
def test_what_is_not_known_or_does_not_fit_is_refused_in_one_line(effects, message):
    with pytest.raises(ValueError, match=message):
        expose(scene(effects=effects))
    assert issubclass(SceneError, ValueError)


@pytest.mark.slow
def test_jitter_is_the_mean_over_gaussian_positions():
    sigma_mas = 8.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    weights = weights / weights.sum()
    coarse = {"sampling": Sampling(128, 1), "window": (32, 32)}
    expected = sum(
        wx * wy * moved(sigma_mas * x, sigma_mas * y, **coarse)
        for x, wx in zip(nodes, weights, strict=True)
        for y, wy in zip(nodes, weights, strict=True)
    )
    effect = {"tip_tilt_jitter": {"sigma_mas": sigma_mas, "correlation_s": 1e-9}}
    assert worst(image(effects=effect, **coarse), expected) < 1e-4


@pytest.mark.slow
def test_jitter_leaves_frames_displaced_by_the_mean_of_its_positions():
    jittering = scene(frames=400, effects={"tip_tilt_jitter": {"sigma_mas": 6.0}}, window=(8, 8), ncpa_nm={})
    tilts = expose(jittering).zernike_nm[:, :2]
    # Ten independent positions of 10 ms each.
    assert np.allclose(tilts.std(axis=0), tilt_nm_rms(6.0) / np.sqrt(10), rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("angle_deg", [0.0, 70.0])
def test_a_vibration_is_the_mean_over_a_sinusoid(angle_deg):
    sigma_mas, angle = 12.0, np.deg2rad(angle_deg)
    swing_mas = np.sqrt(2) * sigma_mas * np.cos(np.pi * (np.arange(12) + 0.5) / 12)
    expected = np.mean([moved(s * np.cos(angle), s * np.sin(angle)) for s in swing_mas], axis=0)
    whole_cycles = {"sigma_mas": sigma_mas, "angle_deg": angle_deg, "frequency_hz": 50.0}
    assert worst(image(effects={"vibration": whole_cycles}), expected) < 1e-4


@pytest.mark.slow
def test_a_gaussian_vibration_is_the_mean_over_gaussian_positions():
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    expected = sum(w / weights.sum() * moved(0.0, 9.0 * y) for y, w in zip(nodes, weights, strict=True))
    effect = {"sigma_mas": 9.0, "angle_deg": 90.0, "frequency_hz": 50.0, "shape": "gaussian"}
    assert worst(image(effects={"vibration": effect}), expected) < 1e-4


@pytest.mark.slow
def test_a_vibration_moves_frames_by_what_is_left_of_its_last_period():
    # A quarter of a period: the mean of a sinusoid of amplitude A over it is A sinc(1/4) cos(phase).
    effect = {"vibration": {"sigma_mas": 5.0, "angle_deg": 30.0, "frequency_hz": 2.5}}
    tilts = expose(scene(frames=300, effects=effect, window=(8, 8), ncpa_nm={})).zernike_nm[:, :2]
    amplitude_nm = tilt_nm_rms(np.sqrt(2) * 5.0 * np.sinc(0.25))
    assert np.allclose(np.hypot(*tilts.T).max(), amplitude_nm, rtol=0.01)
    assert np.allclose(tilts[:, 1], tilts[:, 0] * np.tan(np.deg2rad(30.0)), atol=1e-6)


@pytest.mark.slow
def test_a_halo_on_the_bench_scatters_the_light_of_its_wavefront_error():
    halo = scene(effects={"seeing_halo": {"wfe_nm": 100.0}}, exposure_s=3.0, ncpa_nm={}, diversity_nm={})
    found = of_light(expose(halo), halo)
    core = image(ncpa_nm={}, diversity_nm={}).max()
    # Long exposure: coherent peak exp(-σ²), plus a halo under it of a few per cent of that.
    strehl = np.exp(-((2 * np.pi * 100 / 1600) ** 2))
    assert strehl < found.max() / core < strehl * 1.06


@pytest.mark.parametrize(
    ("effect", "expected_nm"),
    [
        ({"scale": 1.5}, 1.5 * (104.27 * 0.5 + 58.6)),
        ({"wfe_nm": 60.0}, 60.0),
    ],
)
def test_a_halo_on_the_sky_rescales_the_residual(effect, expected_nm):
    happening = with_effective_sky(scene(sky=Sky(0.5), effects={"seeing_halo": effect}))
    assert np.isclose(happening.residual_wfe_nm, expected_nm)


def test_dispersion_moves_wavelengths_apart_about_their_mean():
    bands = (Band(1500.0, 1e-6, 0.25), Band(1700.0, 1e-6, 0.75))
    effect = {"atmospheric_dispersion": {"mas_per_um": 100.0, "angle_deg": 40.0}}
    expected = 0.0
    # 100 mas/µm at the mean wavelength, 1650 nm, of what is very nearly a + b/λ² (Cauchy).
    shifts_mas = [50 * 1.65**3 * (1.65**-2 - um**-2) for um in (1.5, 1.7)]
    for band, shift_mas in zip(bands, shifts_mas, strict=True):
        x_mas, y_mas = shift_mas * np.cos(np.deg2rad(40)), shift_mas * np.sin(np.deg2rad(40))
        expected = expected + moved(x_mas, y_mas, bands=(band,))
    assert worst(image(bands=bands, effects=effect), expected) < 5e-4


def test_chromatic_aberrations_are_those_of_each_wavelength():
    bands = (Band(1500.0, 1e-6, 0.25), Band(1700.0, 1e-6, 0.75))
    table, expected = {4: 200.0, 7: -150.0}, 0.0
    for band, distance_um in zip(bands, (-0.1, 0.1), strict=True):
        opd = {noll: nm + distance_um * table.get(noll, 0.0) for noll, nm in NCPA_NM.items()}
        expected = expected + image(bands=(band,), ncpa_nm=opd)
    found = {"zernike_nm_per_um": table, "reference_nm": 1600.0}
    assert worst(image(bands=bands, effects={"chromatic_ncpa": found}), expected) < 1e-6


def test_the_wavefront_of_a_filter_is_a_part_of_the_truth():
    effects = {"filter_ncpa": {"zernike_nm": {9: 30.0}}}
    found, without = (expose(scene(**given)).mean_zernike_nm() for given in ({"effects": effects}, {}))
    assert np.isclose(found[9] - without[9], 30.0, atol=1e-6)


@pytest.mark.slow
def test_the_spectrum_shifts_and_reddens():
    two = (Band(1500.0, 1e-6, 0.5), Band(1700.0, 1e-6, 0.5))
    shifted = image(bands=two, effects={"spectrum": {"wavelength_nm": 1630.0}})
    expected = image(bands=(Band(1530.0, 1e-6, 0.5), Band(1730.0, 1e-6, 0.5)))
    assert worst(shifted, expected) < 1e-6
    redder = (Band(1500.0, 1e-6, 0.4), Band(1700.0, 1e-6, 0.6))  # 1 ± 0.1 µm · 2 /µm
    assert worst(image(bands=two, effects={"spectrum": {"slope": 2.0}}), image(bands=redder)) < 1e-6
    unequal = image(bands=two, effects={"spectrum": {"weights": [2.0, 3.0]}})
    assert worst(unequal, image(bands=redder)) < 1e-6


def test_the_plate_scale_grows_by_its_fraction():
    found = image(effects={"plate_scale": {"fraction": 0.02}})
    assert worst(found, image(pixel_scale_mas=9.7 * 1.02)) < 1e-9


STRETCHED = {"anamorphism": {"fraction": 0.05, "angle_deg": 33.0}}


def test_the_airy_pattern_is_larger_along_the_angle_of_an_anamorphism():
    """Analysis: scales whose difference is 5 % of their mean and whose product is one."""
    along = np.sqrt(1.025 / 0.975)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    y, x = np.meshgrid(*2 * [((np.arange(25) - 12)[:, None] + nodes / 2).ravel()], indexing="ij")
    c, s = np.cos(np.deg2rad(33.0)), np.sin(np.deg2rad(33.0))
    per_px = 9.7 * MAS_RAD * np.pi * 8.0 / 1.6e-6
    z = np.hypot((c * x + s * y) / along, (c * y - s * x) * along) * per_px
    fine = (2 * j1(z) / z) ** 2 * per_px**2 / (4 * np.pi)  # integral over the plane: 1
    expected = np.einsum("yjxi,j,i->yx", fine.reshape(25, 6, 25, 6), weights / 2, weights / 2)
    disc = {"geometry": PupilGeometry(8.0), "ncpa_nm": {}, "diversity_nm": {}, "window": (25, 25)}
    assert worst(image(effects=STRETCHED, **disc), expected) < 3e-5
    assert worst(image(**disc), expected) > 0.01


@pytest.mark.slow
def test_an_anamorphism_stretches_the_moving_image_of_a_scene_on_sky_as_that_of_one_on_the_bench():
    calm = {"sky": Sky(1e-4, wfe_nm=0.1)}
    bench, jitter = image(effects=STRETCHED), {"tip_tilt_jitter": {"sigma_mas": 10.0}}
    assert worst(image(effects=STRETCHED, **calm), bench) < 1e-4
    blurred = [image(effects=STRETCHED | jitter, frames=40, **more) for more in ({}, calm)]
    assert worst(*blurred) < 1e-3
    turned = image(effects={"anamorphism": {"fraction": 0.05, "angle_deg": 123.0}} | jitter, frames=40)
    assert worst(turned, blurred[0]) > 0.01


def test_the_error_of_the_diversity_is_part_of_the_truth():
    wrong = scene(effects={"diversity_error": {"nm": 25.0}})
    exposed = expose(wrong)
    assert worst(of_light(exposed, wrong), image(diversity_nm={6: -195.0})) < 1e-6
    assert np.isclose(exposed.mean_zernike_nm()[6], NCPA_NM[6] - 25.0)


def test_a_displaced_stop_passes_light_where_both_pupils_do():
    open_pupil = PupilGeometry(8.0, UT4.obscuration_m)
    shifted = scene(geometry=open_pupil, effects={"pupil_misregistration": {"dx_m": 0.12, "dy_m": -0.05}})

    def lens_m2(radius_m: float, distance_m: float) -> float:
        """Overlap of two equal discs."""
        half = np.arccos(distance_m / (2 * radius_m))
        return radius_m**2 * (2 * half - np.sin(2 * half))

    holes, distance_m = 2 * np.pi * open_pupil.obscuration_m**2 / 4, 0.13
    expected = lens_m2(4.0, distance_m) - (holes - lens_m2(open_pupil.obscuration_m / 2, distance_m))
    telescope = telescope_of(shifted)
    assert np.isclose(telescope.area_m2, expected, rtol=1e-4)
    lit = np.flatnonzero(telescope.transmission.sum(axis=0) > 0)
    assert lit[0] > 0 and lit[-1] == len(telescope.u_m) - 1  # moved towards +x


@pytest.mark.slow
def test_clipped_light_is_missing_in_the_image():
    clipped = scene(geometry=PupilGeometry(8.0), effects={"pupil_misregistration": {"dx_m": 0.4}})
    whole = image(geometry=PupilGeometry(8.0), window=(128, 128)).sum()
    lost = telescope_of(clipped).area_m2 / (16 * np.pi)
    found = image(geometry=PupilGeometry(8.0), effects=clipped.effects, window=(128, 128)).sum()
    assert np.isclose(found / whole, lost, rtol=2e-3)


@pytest.mark.slow
def test_vanes_turn_anticlockwise():
    turned = telescope_of(scene(effects={"pupil_misregistration": {"rotation_deg": 30.0}})).transmission
    straight = telescope_of(scene()).transmission
    quarter = telescope_of(scene(effects={"pupil_misregistration": {"rotation_deg": 90.0}})).transmission
    assert np.abs(quarter - np.rot90(straight, -1)).mean() < 1e-3  # rows count upwards
    assert np.abs(turned - straight).mean() > 0.01


@pytest.mark.slow
def test_amplitude_aberrations_shade_the_pupil():
    shade = 1 + reference(SAMPLES).opd_nm({2: 0.1, 4: -0.06})
    shaded("amplitude_aberration", {"zernike": {2: 0.1, 4: -0.06}}, shade)


def test_a_spot_is_darkest_at_its_centre():
    """Truth: HCIPy's pupil, times the formula."""
    spot = {"opacity": 0.9, "x_m": 1.5, "y_m": -2.0, "radius_m": 0.6}
    grid = reference(SAMPLES).grid
    distance2 = (grid.x - 1.5) ** 2 + (grid.y + 2.0) ** 2
    shaded("pupil_spot", spot, 1 - 0.9 * np.exp(-np.log(2) * distance2**2 / 0.6**4))


def shaded(name: str, parameters: dict, shade: np.ndarray) -> None:
    """Compare an image with that of HCIPy's pupil whose amplitude is multiplied by a `shade`."""
    source = reference(SAMPLES)
    found = image(effects={name: parameters})
    lit = source.transmission
    source.transmission = lit * shade
    try:
        expected = source.image(TOTAL_NM, 1600.0, (48, 48), 9.7)
    finally:
        source.transmission = lit
    assert worst(found, expected) < 1e-4


def petal_map(source) -> np.ndarray:
    """Low-wind wavefront on HCIPy's grid [nm]: petals are what the vanes leave connected."""
    shape = (SAMPLES, SAMPLES)
    parts, count = label(source.transmission.reshape(shape) > 0.99)
    x, y = np.asarray(source.grid.x).reshape(shape), np.asarray(source.grid.y).reshape(shape)
    sizes = np.bincount(parts.ravel())[1:]
    petals = [number for number in range(1, count + 1) if sizes[number - 1] > 1000]
    angles = [np.rad2deg(np.arctan2(y[parts == k].mean(), x[parts == k].mean())) % 360 for k in petals]
    opd = np.zeros(shape)
    for order, (angle, k) in enumerate(sorted(zip(angles, petals, strict=True))):
        assert abs(angle - (45 + 90 * order)) < 10
        plane = PETALS["tip_nm"][order] * x + PETALS["tilt_nm"][order] * y
        opd[parts == k] = (PETALS["piston_nm"][order] + plane / 2)[parts == k]  # Noll 2 is 2 x / 4 m
    return opd


def test_low_wind_petals_follow_each_other_anticlockwise_from_the_diagonal():
    source = reference(SAMPLES)
    expected, found = petal_map(source), petals_on(source)
    assert np.allclose(found[expected != 0], expected[expected != 0], atol=1e-9)


def petals_on(source) -> np.ndarray:
    """The simulator's low-wind wavefront at the points of HCIPy's grid [nm]."""
    x, y = np.asarray(source.grid.x), np.asarray(source.grid.y)
    return LowWindEffect(**PETALS).steps_nm(UT4, x, y).reshape(SAMPLES, SAMPLES)


@pytest.mark.slow
def test_low_wind_images_agree_with_hcipy():
    source = reference(SAMPLES)
    opd_nm = source.opd_nm(TOTAL_NM) + petals_on(source).ravel()
    expected = source.image(opd_nm, 1600.0, (48, 48), 9.7)
    assert worst(image(effects={"low_wind_effect": PETALS}), expected) < 1e-4


@pytest.mark.slow
def test_low_wind_petals_are_part_of_the_truth():
    exposed = expose(scene(effects={"low_wind_effect": PETALS}, ncpa_nm={}))
    x, y = np.meshgrid(*[exposed.telescope.u_m] * 2)
    assert np.allclose(exposed.mean_opd_nm, LowWindEffect(**PETALS).steps_nm(UT4, x, y), atol=1e-6)


def test_modes_beyond_the_estimated_ones_are_added():
    found = expose(scene(effects={"high_order_ncpa": {"zernike_nm": {60: 30.0, 6: 5.0}}}))
    fitted = dict(enumerate(found.telescope.fit_zernike_nm(found.mean_opd_nm, 66), start=2))
    assert np.isclose(fitted[60], 30.0) and np.isclose(fitted[6], NCPA_NM[6] + 5.0)
    assert np.isclose(found.mean_zernike_nm()[6], NCPA_NM[6] + 5.0)


def test_a_bump_stands_where_it_is_told():
    bump = {"nm": 150.0, "x_m": 1.5, "y_m": -2.0, "width_m": 0.4}
    exposed = expose(scene(ncpa_nm={}, effects={"phase_bump": bump}))
    u_m, opd_nm = exposed.telescope.u_m, exposed.mean_opd_nm
    row, column = np.unravel_index(opd_nm.argmax(), opd_nm.shape)
    assert np.allclose([u_m[column], u_m[row]], [1.5, -2.0], atol=0.04)
    assert np.isclose(opd_nm.sum() * exposed.telescope.step_m**2, 150 * 2 * np.pi * 0.4**2, rtol=1e-3)


def test_a_drift_is_linear_over_the_cube_and_its_mean_is_in_the_truth():
    drifting = scene(frames=5, ncpa_nm={}, effects={"ncpa_drift": {"zernike_nm": {5: 40.0, 37: 50.0}}})
    exposed = expose(drifting)
    assert np.allclose(exposed.zernike_nm[:, 3], [0, 10, 20, 30, 40])
    assert np.allclose(np.delete(exposed.zernike_nm, 3, axis=1), 0.0, atol=1e-6)
    assert np.isclose(exposed.mean_zernike_nm()[5], 20.0)
    last = exposed.mean_e[-1] / drifting.photons
    assert worst(last, image(ncpa_nm={5: 40.0, 37: 50.0})) < 1e-6


def test_a_companion_adds_its_light_in_its_place():
    angle = np.deg2rad(300.0)
    found = image(effects={"companion": {"flux_ratio": 0.04, "sep_mas": 150.0, "pa_deg": 300.0}})
    second = moved(150 * np.cos(angle), 150 * np.sin(angle))
    assert worst(found, image() + 0.04 * second) < 1e-6


def test_a_ghost_is_sharp_unless_it_is_said_to_be_out_of_focus_or_blurred():
    place = {"flux_ratio": 0.04, "sep_mas": 150.0, "pa_deg": 300.0}
    assert np.array_equal(image(effects={"ghost": place}), image(effects={"companion": place}))
    angle = np.deg2rad(300.0)
    second = moved(150 * np.cos(angle), 150 * np.sin(angle), introduced_nm=80.0)
    found = image(effects={"ghost": place | {"defocus_nm": 80.0}})
    assert worst(found, image() + 0.04 * second) < 1e-6


def test_the_blur_of_a_ghost_is_that_of_gaussian_motion():
    """Truth: jitter of the star's image, which the simulator applies to the spectrum of the image."""
    ghost = {"flux_ratio": 1.0, "sep_mas": 0.0, "pa_deg": 0.0, "blur_mas": 12.0}
    found = image(effects={"ghost": ghost}) - image()
    jitter = {"tip_tilt_jitter": {"sigma_mas": 12.0, "correlation_s": 1e-9}}
    assert worst(found, image(effects=jitter)) < 1e-4


def test_a_companion_has_a_ghost_too():
    ghost = {"flux_ratio": 0.1, "sep_mas": 100.0, "pa_deg": 0.0}
    companion = {"flux_ratio": 0.2, "sep_mas": 80.0, "pa_deg": 90.0}
    found = image(effects={"ghost": ghost, "companion": companion})
    expected = image() + 0.2 * moved(0.0, 80.0) + 0.1 * moved(100.0, 0.0) + 0.02 * moved(100.0, 80.0)
    assert worst(found, expected) < 1e-6


@pytest.mark.parametrize(
    ("effect", "expected_nm"),
    [
        ({"focus_stage_offset": {"nm": 30.0}}, [30, 30, 30, 30]),
        ({"focus_stage_offset": {"nm": 30.0, "above_nm": 0.0}}, [30, 0, 0, 30]),
        ({"focus_stage_scale": {"fraction": 0.1}}, [10, -10, 0, 20]),
        ({"focus_stage_hysteresis": {"nm": 12.0}}, [12, -12, 12, 12]),
        ({"focus_stage_hysteresis": {"nm": 12.0, "direction": -1}}, [-12, -12, 12, 12]),
    ],
)
def test_what_the_focus_stage_misses_is_in_the_truth(effect, expected_nm):
    ramp = scene(frames=4, introduced_nm=(100.0, -100.0, 0.0, 200.0), ncpa_nm={}, effects=effect)
    exposed = expose(ramp)
    assert np.allclose(exposed.zernike_nm[:, 2], expected_nm, atol=1e-6)
    reached = image(ncpa_nm={}, introduced_nm=200.0 + expected_nm[-1])
    assert worst(exposed.mean_e[-1] / ramp.photons, reached) < 1e-6


def test_the_scatter_of_the_stage_is_drawn_for_every_move():
    offsets = tuple(np.repeat(np.arange(1.0, 101.0), 2))
    effect = {"focus_stage_hysteresis": {"nm": 0.0, "scatter_nm": 15.0}}
    quick = {"ncpa_nm": {}, "window": (2, 2), "sampling": Sampling(32, 1)}
    ramp = scene(frames=200, introduced_nm=offsets, effects=effect, **quick)
    missed = expose(ramp).zernike_nm[:, 2]
    assert np.allclose(missed[::2], missed[1::2])
    assert np.isclose(missed.std(), 15.0, rtol=0.2)


@pytest.mark.parametrize(
    ("effect", "parameters"),
    [
        ("seeing_halo", {"scale": 1.5}),
        ("companion", {"flux_ratio": 0.1, "sep_mas": 120.0, "pa_deg": 10.0}),
        ("low_wind_effect", PETALS),
        ("vibration", {"sigma_mas": 15.0}),
    ],
)
def test_effects_act_under_a_sky_too(effect, parameters):
    sky = {"sky": Sky(0.4), "exposure_s": 0.02}
    plain, changed = image(**sky), image(**sky, effects={effect: parameters})
    assert worst(changed, plain) > 0.01
