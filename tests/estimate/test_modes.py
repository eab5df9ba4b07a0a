"""How many modes the frames support. Truth: frames drawn from the model with a known number of modes (same
code, on purpose: only the number of modes is in question), and the expectation of χ²."""

import numpy as np
import pytest
from helpers import optics_cases as cases
from scipy.stats import chi2

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.correction import mirror_offsets
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.mode_number import ModeScatter, choose, fit_mode_law, mode_scatter, scan_mode_numbers
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.wavefront import clear_pupil, opd_maps_nm

FRAMES, FLUX, WINDOW = 48, 3e5, 40
NOLLS = tuple(range(2, 16))
NUMBERS = (6, 10, 15, 21, 28)


@pytest.fixture(scope="module")
def truth_nm() -> dict[int, float]:
    """Fourteen modes, the last five of 30 nm each."""
    return cases.ncpa_nm(4, highest_noll=10, total_nm=80.0) | dict.fromkeys(range(11, 16), 30.0)


@pytest.fixture(scope="module")
def scan(truth_nm):
    image = PsfModel(cases.settings(WINDOW), NOLLS).images(cases.vector(truth_nm, NOLLS))
    images = cases.draw_frames(image[0].double().numpy() * FLUX, FRAMES, seed=1)
    frames = Frames(images, cases.everything(images), cases.READ_NOISE)
    return scan_mode_numbers(frames, cases.settings(WINDOW), CalibrationOptions(), NUMBERS)


@pytest.mark.slow
def test_the_simulated_number_is_recommended(scan):
    choice = choose(scan.misfit)
    assert scan.highest_nolls[choice.recommended] == 15


@pytest.mark.slow
def test_unseen_frames_see_too_few_modes_and_too_many(scan):
    misfit = scan.misfit.mean(axis=1)
    assert misfit[0] > misfit[1] > misfit[2] + 0.1
    assert misfit[2] < misfit[3] < misfit[4]


@pytest.mark.slow
def test_halves_differ_as_their_mean_errs(scan, truth_nm):
    true = np.array([truth_nm.get(noll, 0.0) for noll in scan.nolls])
    error = np.linalg.norm(scan.mean_nm[2] - true)
    assert 0.5 < scan.halves_nm[2] / error < 2
    assert np.linalg.norm(scan.mean_nm[0] - true) > 10 * error


def test_the_smallest_number_within_the_error_of_the_best_is_chosen():
    rng = np.random.default_rng(1)
    shared = rng.normal(size=16)  # what all numbers have in common falls out
    misfit = np.array([3.0, 1.0005, 1.0, 1.2])[:, None] + shared + 0.01 * rng.normal(size=(4, 16))
    choice = choose(misfit)
    assert choice.recommended == 1
    assert choice.excess_sigma[choice.best] == 0
    assert choice.excess[3] > 5 * choice.excess_sigma[3]


# Law of the standard deviation of modes. Truth: draws from a known law, and the theory of χ².


MODE_LAW_NOLLS = tuple(range(2, 102))
A_NM, DECAY, C_NM = 70.0, 0.2, 10.0
START = NcpaLaw(100.0, 0.3, 5.0)
LAW_NM = A_NM * np.exp(-DECAY * np.arange(100)) + C_NM
NOISE_NM = 6.0
ALL = np.ones(100, bool)


def scatter_of(draws: int, seed: int, noise_nm: float = NOISE_NM) -> ModeScatter:
    """Scatter of noisy estimates of drawn modes."""
    rng = np.random.default_rng(seed)
    true = LAW_NM * rng.normal(size=(draws, 100))
    sigma = np.full(true.shape, noise_nm)
    return mode_scatter(MODE_LAW_NOLLS, true + sigma * rng.normal(size=true.shape), sigma)


def test_an_exact_law_is_returned():
    scatter = ModeScatter(MODE_LAW_NOLLS, LAW_NM, np.zeros(100), 10)
    law = fit_mode_law(scatter, ALL, START, remove_noise=False)
    assert (law.a_nm, law.decay, law.plateau_nm) == pytest.approx((A_NM, DECAY, C_NM), rel=1e-5)
    assert law(MODE_LAW_NOLLS) == pytest.approx(LAW_NM, rel=1e-5)
    # 70 exp(−0.2 i) < 1 from i = ln(70) / 0.2 = 21.2 on
    assert law.plateau_noll == 24


@pytest.mark.slow
@pytest.mark.parametrize("draws", [1, 20])
def test_parameters_scatter_as_their_errors_say(draws):
    pulls, deviances = [], []
    for seed in range(150):
        law = fit_mode_law(scatter_of(draws, seed), ALL, START, remove_noise=True)
        logs = np.log([law.a_nm / A_NM, law.decay / DECAY, law.plateau_nm / C_NM])
        pulls.append(logs / np.sqrt(np.diag(law.covariance)))
        deviances.append(law.deviance_nu)
    assert np.std(pulls, axis=0) == pytest.approx([1, 1, 1], abs=0.25)
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.35  # a law from few modes is skewed
    assert np.mean(deviances) == pytest.approx(1, abs=0.06)


def test_the_error_of_a_standard_deviation_is_that_of_chi2():
    draws = 20
    scatter = scatter_of(draws, 2)
    exact = np.sqrt(chi2(draws).ppf([0.1587, 0.8413]) / draws)
    assert scatter.std_sigma_nm / scatter.std_nm == pytest.approx(np.diff(exact)[0] / 2, rel=0.05)


# Offsets of a mirror's modes. Truth: tables whose best fit is known by hand; Monte Carlo for the errors.


SAMPLES = 64
LIT = clear_pupil(cases.FACILITY.pupil, SAMPLES)
MIRROR_MODES_NOLLS = list(range(2, 22))
EVERYWHERE = np.ones_like(LIT)
RNG = np.random.default_rng(7)
WAVEFRONT_NM = 30 * RNG.standard_normal(len(MIRROR_MODES_NOLLS))
ROOT = RNG.standard_normal((len(MIRROR_MODES_NOLLS), len(MIRROR_MODES_NOLLS)))
COVARIANCE_NM2 = ROOT @ ROOT.T


def table(mixture: np.ndarray) -> np.ndarray:
    """Maps of mixtures of Noll 4 to 21, (modes, Noll modes)."""
    return opd_maps_nm(range(4, 22), mixture, EVERYWHERE)


def offsets(maps_nm: np.ndarray, gain: float = 1.0):
    return mirror_offsets(maps_nm, MIRROR_MODES_NOLLS, WAVEFRONT_NM, COVARIANCE_NM2, LIT, gain)


def test_a_table_of_mixed_polynomials_makes_the_same_wavefront():
    """As many independent mixtures as polynomials are another basis of the same wavefronts."""
    mixture = RNG.standard_normal((18, 18))
    found = offsets(table(mixture))
    assert found.value @ mixture == pytest.approx(-WAVEFRONT_NM[2:], rel=1e-6)
    assert found.after_nm < 1e-6 * found.before_nm


def test_errors_are_those_of_the_wavefront():
    """Offsets are linear in the wavefront: its covariance carried on by the offsets of every mode alone."""
    maps_nm = table(RNG.standard_normal((18, 18)))
    by_mode = [
        mirror_offsets(maps_nm, MIRROR_MODES_NOLLS, one, COVARIANCE_NM2, LIT).value
        for one in np.eye(len(MIRROR_MODES_NOLLS))
    ]
    expected = np.sqrt(np.diag(np.transpose(by_mode) @ COVARIANCE_NM2 @ by_mode))
    assert offsets(maps_nm).sigma == pytest.approx(expected, rel=1e-6)


def test_what_the_modes_cannot_make_is_left():
    """Of two orthogonal shapes one is in the table."""
    full = offsets(table(np.eye(18)[2:3]))
    assert 0 < full.after_nm < full.before_nm
    assert full.before_nm**2 - full.after_nm**2 == pytest.approx(
        float(np.var(full.value[0] * _without_tilt(table(np.eye(18)[2:3])[0]))), rel=1e-9
    )


def _without_tilt(map_nm: np.ndarray) -> np.ndarray:
    y, x = (axis[LIT] for axis in np.mgrid[:SAMPLES, :SAMPLES])
    plane = np.column_stack([x, y, np.ones_like(x)]).astype(float)
    return map_nm[LIT] - plane @ np.linalg.lstsq(plane, map_nm[LIT], rcond=None)[0]


def test_holes_outside_the_pupil_are_no_matter_and_inside_they_are_refused():
    maps_nm = table(np.eye(18))
    outside = np.where(LIT, maps_nm, np.nan)
    assert offsets(outside).value == pytest.approx(offsets(maps_nm).value)
    maps_nm[3, SAMPLES // 4, SAMPLES // 4] = np.nan
    with pytest.raises(ValueError, match="not a number"):
        offsets(maps_nm)
