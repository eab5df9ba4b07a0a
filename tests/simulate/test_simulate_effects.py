"""Every effect of the catalogue that acts before the detector.

Truth: HCIPy on a finer pupil for what changes the pupil; equal scenes told in another way (a moved
image is a tilted wavefront, a shifted band is another band); areas and moments by analysis.
"""

import numpy as np
import pytest
from helpers.reference_psf import reference
from helpers.simulated_scenes import MAS_RAD, NCPA_NM, UT4, image, of_light, scene, tilt_nm_rms, worst
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects.pupil import LowWindEffect
from irlos_pipe.simulate.exposure import expose, telescope_of, with_effective_sky
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Sampling

SAMPLES = 512  # of HCIPy's pupil
TOTAL_NM = {**NCPA_NM, 6: NCPA_NM[6] - 170.0}
PETALS = {"piston_nm": [70, -70, 50, -30], "tip_nm": [0, 20, 0, -20], "tilt_nm": [25, 0, -25, 0]}


def moved(x_mas: float, y_mas: float, **changes) -> np.ndarray:
    """Image moved by tilting the wavefront."""
    tilted = dict(NCPA_NM)
    tilted[2] += tilt_nm_rms(x_mas)
    tilted[3] += tilt_nm_rms(y_mas)
    return image(**{"ncpa_nm": tilted} | changes)


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
@pytest.mark.parametrize("angle_deg", [0.0, 70.0])
def test_a_vibration_is_the_mean_over_a_sinusoid(angle_deg):
    sigma_mas, angle = 12.0, np.deg2rad(angle_deg)
    swing_mas = np.sqrt(2) * sigma_mas * np.cos(np.pi * (np.arange(12) + 0.5) / 12)
    expected = np.mean([moved(s * np.cos(angle), s * np.sin(angle)) for s in swing_mas], axis=0)
    whole_cycles = {"sigma_mas": sigma_mas, "angle_deg": angle_deg, "frequency_hz": 50.0}
    assert worst(image(effects={"vibration": whole_cycles}), expected) < 1e-4


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
def test_vanes_turn_anticlockwise():
    turned = telescope_of(scene(effects={"pupil_misregistration": {"rotation_deg": 30.0}})).transmission
    straight = telescope_of(scene()).transmission
    quarter = telescope_of(scene(effects={"pupil_misregistration": {"rotation_deg": 90.0}})).transmission
    assert np.abs(quarter - np.rot90(straight, -1)).mean() < 1e-3  # rows count upwards
    assert np.abs(turned - straight).mean() > 0.01


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


def test_a_drift_is_linear_over_the_cube_and_its_mean_is_in_the_truth():
    drifting = scene(frames=5, ncpa_nm={}, effects={"ncpa_drift": {"zernike_nm": {5: 40.0, 37: 50.0}}})
    exposed = expose(drifting)
    assert np.allclose(exposed.zernike_nm[:, 3], [0, 10, 20, 30, 40])
    assert np.allclose(np.delete(exposed.zernike_nm, 3, axis=1), 0.0, atol=1e-6)
    assert np.isclose(exposed.mean_zernike_nm()[5], 20.0)
    last = exposed.mean_e[-1] / drifting.photons
    assert worst(last, image(ncpa_nm={5: 40.0, 37: 50.0})) < 1e-6


def test_a_ghost_is_sharp_unless_it_is_said_to_be_out_of_focus_or_blurred():
    place = {"flux_ratio": 0.04, "sep_mas": 150.0, "pa_deg": 300.0}
    assert np.array_equal(image(effects={"ghost": place}), image(effects={"companion": place}))
    angle = np.deg2rad(300.0)
    second = moved(150 * np.cos(angle), 150 * np.sin(angle), introduced_nm=80.0)
    found = image(effects={"ghost": place | {"defocus_nm": 80.0}})
    assert worst(found, image() + 0.04 * second) < 1e-6


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
