"""Law of the standard deviation of modes. Truth: draws from a known law, and the theory of χ²."""

import numpy as np
import pytest
from scipy.stats import chi2

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.mode_law import ModeScatter, fit_mode_law, mode_scatter

NOLLS = tuple(range(2, 102))
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
    return mode_scatter(NOLLS, true + sigma * rng.normal(size=true.shape), sigma)


def test_an_exact_law_is_returned():
    scatter = ModeScatter(NOLLS, LAW_NM, np.zeros(100), 10)
    law = fit_mode_law(scatter, ALL, START, remove_noise=False)
    assert (law.a_nm, law.decay, law.plateau_nm) == pytest.approx((A_NM, DECAY, C_NM), rel=1e-5)
    assert law(NOLLS) == pytest.approx(LAW_NM, rel=1e-5)
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


def test_noise_raises_the_plateau_unless_it_is_taken_out():
    scatter = scatter_of(200, 1)
    raw = fit_mode_law(scatter, ALL, START, remove_noise=False)
    clean = fit_mode_law(scatter, ALL, START, remove_noise=True)
    assert raw.plateau_nm == pytest.approx(np.hypot(C_NM, NOISE_NM), rel=0.03)
    assert clean.plateau_nm == pytest.approx(C_NM, rel=0.03)


def test_the_error_of_a_standard_deviation_is_that_of_chi2():
    draws = 20
    scatter = scatter_of(draws, 2)
    exact = np.sqrt(chi2(draws).ppf([0.1587, 0.8413]) / draws)
    assert scatter.std_sigma_nm / scatter.std_nm == pytest.approx(np.diff(exact)[0] / 2, rel=0.05)
