"""Effects that move or change from frame to frame, and what the truth says of them.

Truth: equal scenes told in another way (a moved image is a tilted wavefront); moments by analysis. In
test_simulate_imaging static effects are those of the model.
"""

import numpy as np
import pytest
from helpers.simulated_scenes import NCPA_NM, image, of_light, scene, tilt_nm_rms, worst

from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose, with_effective_sky
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Sampling


def moved(x_mas: float, y_mas: float, **changes) -> np.ndarray:
    """Image moved by tilting the wavefront."""
    tilted = dict(NCPA_NM)
    tilted[2] += tilt_nm_rms(x_mas)
    tilted[3] += tilt_nm_rms(y_mas)
    return image(**{"ncpa_nm": tilted} | changes)


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


def test_bands_have_factors_of_their_own():
    two, redder = ((Band(1500.0, 1e-6, a), Band(1700.0, 1e-6, b)) for a, b in ((0.5, 0.5), (0.4, 0.6)))
    unequal = image(bands=two, effects={"spectrum": {"weights": [2.0, 3.0]}})
    assert worst(unequal, image(bands=redder)) < 1e-6


def test_the_error_of_the_diversity_is_part_of_the_truth():
    wrong = scene(effects={"diversity_error": {"nm": 25.0}})
    exposed = expose(wrong)
    assert worst(of_light(exposed, wrong), image(diversity_nm={6: -195.0})) < 1e-6
    assert np.isclose(exposed.mean_zernike_nm()[6], NCPA_NM[6] - 25.0)


def test_a_drift_is_linear_over_the_cube_and_its_mean_is_in_the_truth():
    drifting = scene(frames=5, ncpa_nm={}, effects={"ncpa_drift": {"zernike_nm": {5: 40.0, 37: 50.0}}})
    exposed = expose(drifting)
    assert np.allclose(exposed.zernike_nm[:, 3], [0, 10, 20, 30, 40])
    assert np.allclose(np.delete(exposed.zernike_nm, 3, axis=1), 0.0, atol=1e-6)
    assert np.isclose(exposed.mean_zernike_nm()[5], 20.0)
    last = exposed.mean_e[-1] / drifting.photons
    assert worst(last, image(ncpa_nm={5: 40.0, 37: 50.0})) < 1e-6


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
