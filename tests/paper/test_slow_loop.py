"""The slow focus loop. Truth: the difference equation by Monte Carlo against its linear theory, closed forms
(random walk, deadbeat control, poles), and images simulated without interpolation."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import drawn, run_on, sample, tables_of

from irlos_pipe.control.linear_theory import Drift, Integrator, SodiumLayer, best_gain
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.paper import slow_loop
from irlos_pipe.paper.common.focus_loop import (
    TWO_BY_TWO,
    FrameTable,
    Loop,
    Records,
    close_loops,
    frame_table,
    outcome_of,
    two_by_two_sensors,
)
from irlos_pipe.paper.common.scenes import in_four_images, star_scene
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Sampling

LAYER = SodiumLayer(1.95, 23.0, 89.4e3)
DRIFT = LAYER.drift(8.0)


# -- the disturbance ---------------------------------------------------------------------------------


def test_a_layer_that_rises_defocuses_by_the_difference_of_two_spheres():
    """Against the wavefronts themselves: sag from two distances, defocus by projection on the disc."""
    layer, diameter, rise = LAYER, 8.0, 100.0
    rho = np.sqrt((np.arange(20000) + 0.5) / 20000)  # equal areas
    sag = [np.sqrt(h**2 + (rho * diameter / 2) ** 2) - h for h in (layer.range_m, layer.range_m + rise)]
    defocus = np.mean((sag[0] - sag[1]) * np.sqrt(3) * (2 * rho**2 - 1)) * 1e9
    assert layer.defocus_per_metre_nm(diameter) * rise == pytest.approx(defocus, rel=3e-3)


@pytest.mark.parametrize("slope", [1.6, 1.95, 2.0, 2.4])
def test_the_spectrum_has_the_structure_function(slope):
    """Numerical quadrature of ``2 ∫ S (1 - cos 2πfτ) df``."""
    drift, lag = Drift(slope, 3.0), 7.0
    edges = np.concatenate([np.geomspace(1e-7, 1e-2, 4000), np.arange(1e-2, 400, 2e-3)[1:]])
    f, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    value = np.sum(2 * drift.psd_nm2_hz(f) * (1 - np.cos(2 * np.pi * f * lag)) * width)
    tail = 2 * drift.psd_nm2_hz(400.0) * 400 / (slope - 1)
    assert value + tail == pytest.approx(drift.structure_nm2(lag), rel=0.01)


def test_drifts_have_the_structure_function_at_every_lag():
    rng = np.random.default_rng(1)
    drifts = np.array([DRIFT.draw_nm(rng, 256, 0.1) for _ in range(1500)])
    for steps in (1, 10, 100, 255):
        measured = np.mean((drifts[:, steps] - drifts[:, 0]) ** 2)
        assert measured == pytest.approx(DRIFT.structure_nm2(0.1 * steps), rel=0.13)  # 3.5 sigma of 1500


# -- linear theory -----------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1.0, 20.0])
def test_the_best_gain_is_a_minimum(noise):
    best = best_gain(DRIFT, noise)
    here, *others = (Integrator(best * factor).residual_nm(DRIFT, noise) for factor in (1, 0.9, 1.1))
    assert here < min(others)
    assert best_gain(DRIFT, 2 * noise) < best


# -- the loop itself ---------------------------------------------------------------------------------


class PerfectSensor:
    """Reads the defocus out of `linear_table`'s two pixels."""

    def measure(self, images_e, noise):
        a, b = images_e[:, 0, 0], images_e[:, 0, 1]
        return 100 * (a - b) / (a + b)


def linear_table(frames: int) -> FrameTable:
    """Two pixels that share the light in the ratio 1 ± defocus / 100 nm."""
    series = np.zeros((2, frames, 1, 2))
    series[0], series[1] = 1e10, np.array([1e10, -1e10])
    return FrameTable(100.0, series, np.zeros(frames))


def scene(frames=1):
    star = star_scene("test", cases.FACILITY, (5,), frames, 12.0, cases.ncpa_nm(1), seeing_arcsec=0.5)
    return replace(star, sampling=Sampling(64, 1, 0.25))


def closed(loops, drift, sensor, delay=1):
    bright = replace(scene(), window=(1, 2), detector=replace(scene().detector, e_per_adu=1e9))
    scenes, table = dict.fromkeys((1, 2), bright), linear_table(len(drift))
    return close_loops(loops, {"one": sensor}, scenes, table, drift, delay, np.random.default_rng(0))


def test_a_step_is_taken_out_after_the_delay():
    drift = np.concatenate([np.zeros(3), np.full(6, 40.0)])
    record = closed([Loop("one", 12.0, 1.0)], drift, PerfectSensor(), delay=0)
    assert record.residual_nm[0] == pytest.approx([0, 0, 0, 40, 0, 0, 0, 0, 0], abs=0.1)
    late = closed([Loop("one", 12.0, 0.5)], drift, PerfectSensor(), delay=1).residual_nm[0]
    assert late == pytest.approx([0, 0, 0, 40, 40, 20, 0, -10, -10], abs=0.1)


@pytest.mark.slow
def test_the_loop_leaves_what_theory_predicts_of_a_real_drift():
    frames, sub = 3000, 10
    drift = DRIFT.draw_nm(np.random.default_rng(4), frames * sub, 1 / sub).reshape(frames, sub).mean(1)
    record = closed([Loop("one", 12.0, 0.4)], drift, PerfectSensor())
    outcome = outcome_of(Records(*(one[None] for one in record)), DRIFT, 30)
    assert outcome["residual_nm"] == pytest.approx(Integrator(0.4).residual_nm(DRIFT, 0.0), rel=0.06)
    assert outcome["slope"] == pytest.approx(1, abs=1e-3)
    assert Integrator(0.4).gain_margin(outcome["slope"]) == pytest.approx(2.5, rel=2e-3)


# -- simulated frames --------------------------------------------------------------------------------


@pytest.mark.slow
def test_interpolated_frames_are_those_simulated_at_that_defocus():
    star = scene(2)
    table = frame_table(star, 240.0, 8)
    for defocus in (-230.0, 33.0, 170.0):
        direct = expose(replace(star, introduced_nm=defocus)).mean_e
        interpolated = np.array([table.images_e(frame, np.array([defocus]))[0] for frame in range(2)])
        assert np.abs(interpolated - direct).max() < 5e-4 * direct.max()


# -- everything together -----------------------------------------------------------------------------

LOOPS = tuple(Loop("uncalibrated", *one) for one in ((12.0, 0.4), (25.0, 0.1), (12.0, 0.4, 2)))


def run(loops, frames) -> list[dict]:
    star = sample(slow_loop, (3, 1), sizes={"frames": frames}, loops=loops, drift=DRIFT, read=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slow_loop, "REACH_NM", 120.0)
        patch.setattr(slow_loop, "NODES", 6)
        return list(slow_loop.rows(star))


@pytest.mark.slow
def test_loops_measure_and_correct_what_they_leave_and_faint_ones_lose_measurements(monkeypatch):
    found = bright, faint, longer = run(LOOPS, 10)
    error = (bright["measured_nm"] - bright["true_nm"])[0]
    # The sky's own defocus; the bias by the NCPAs is in the median.
    assert np.abs(error - np.median(error)).max() < 25
    assert np.isnan(faint["measured_nm"][0]).mean() > 0.5 and np.isfinite(bright["measured_nm"][0]).all()
    assert longer["bound_nm"] == pytest.approx(bright["bound_nm"] / np.sqrt(2), rel=0.01)
    # 13 magnitudes are a factor 398 while photons rule, more with read noise.
    assert faint["bound_nm"] > 400 * bright["bound_nm"]
    sizes = {"skies": 2, "settle": 4, "configurations": ("uncalibrated",), "half_rate": False}
    sizes |= {"magnitudes": (12.0,), "scan_magnitudes": ()}
    output = run_on(monkeypatch, slow_loop, lambda one: found, **sizes)
    rows = tables_of(output)["loops"]
    assert [*zip(rows.mag_j, rows.exposures, rows.runs, strict=True)] == [(12, 1, 2), (25, 1, 2), (12, 2, 2)]
    assert rows.gain_margin[0] * rows.gain[0] * rows.slope[0] == pytest.approx(1)
    *_, table = drawn(output, slow_loop).blocks
    assert len(table.rows) == 3


# -- the 2x2 mode ------------------------------------------------------------------------------------


def bench_in_four(**changes):
    """The 2x2 mode without sky and motion: nothing but NCPAs lies between star and sensor."""
    return replace(in_four_images(scene(5)), sky=None, motion=None, **changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", TWO_BY_TWO)
def test_four_images_show_the_defocus_that_the_simulator_put_in(name):
    """The simulator shares no optics with the sensors. Centroids above a threshold have a gain of their own,
    7 % off without NCPAs (docs/two_by_two.md); a fit has none."""
    defocus = np.array([-60.0, -20.0, 0.0, 20.0, 60.0])
    star = bench_in_four(introduced_nm=tuple(defocus))
    images_e = expose(star).mean_e
    sensor = two_by_two_sensors(star)[name]
    fit = np.polyfit(defocus, sensor.measure(images_e, NoiseModel(1.0, 1.0)), 1)
    assert fit[0] == pytest.approx(1, abs=0.03 if name == "lift_2x2" else 0.2)


@pytest.mark.slow
def test_their_zero_is_that_of_the_star_without_defocus():
    """The star's NCPAs have 21 nm of defocus, and others that displace the images as defocus does."""
    star = bench_in_four()
    table = frame_table(star, 120.0, 4)
    raw = two_by_two_sensors(star)
    noise, images_e = NoiseModel(1.0, 1.0), table.images_e(0, np.zeros(1))
    for name, sensor in two_by_two_sensors(star, table).items():
        assert sensor.measure(images_e, noise) == pytest.approx(0.0, abs=0.5)
        assert abs(raw[name].measure(images_e, noise)[0]) > 10.0


@pytest.mark.slow
def test_centroids_scatter_as_drawn_images_do_and_no_less_than_the_bound():
    """Monte Carlo with Poisson noise, where the sensor draws Gaussian noise of the same variance."""
    star = replace(in_four_images(scene(30)), ncpa_nm={})
    sensor = two_by_two_sensors(star)["centroids_2x2"]
    mean_e = expose(star).mean_e.astype(float).mean(axis=0)
    mean_e *= 2e4 / mean_e.sum()
    rng = np.random.default_rng(8)
    images_e = rng.poisson(mean_e, (400, *mean_e.shape)) + rng.standard_normal((400, *mean_e.shape))
    noise = NoiseModel(1.0, 1.0)
    scatter = np.nanstd(sensor.measure(images_e, noise))
    assert sensor.photon_noise_nm(2e4, noise) == pytest.approx(scatter, rel=0.15)  # each to 4 %
    assert scatter > sensor.bound_nm(2e4, noise)
