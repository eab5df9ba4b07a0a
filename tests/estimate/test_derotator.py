"""What turns and what does not. Truth: series made with the wavefront evaluated at rotated points;
errors against Monte Carlo; the variance for equal errors against the textbook formula."""

import numpy as np
import pytest

from irlos_pipe.estimate.derotator import Series, consistency, split_series, try_both_senses, usable_modes
from irlos_pipe.optics.zernike import zernike_basis

NOLLS = tuple(range(4, 29))
SYMMETRIC = np.isin(NOLLS, (4, 11, 22))
ANGLES = np.array([0, 23, 46, 69, 92, 115, 138, 161, 180.0])
TRIALS = 600


def turned(zernike_nm: np.ndarray, angle_deg: float) -> np.ndarray:
    """Coefficients of the wavefront turned anticlockwise, by projecting it again."""
    radius = np.sqrt((np.arange(60) + 0.5) / 60)[:, None]
    azimuth = 2 * np.pi * np.arange(64) / 64
    x, y = (radius * np.cos(azimuth)).ravel(), (radius * np.sin(azimuth)).ravel()
    angle = np.radians(angle_deg)
    before = zernike_basis(
        NOLLS, x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    )
    return np.linalg.lstsq(zernike_basis(NOLLS, x, y).T, zernike_nm @ before, rcond=None)[0]


@pytest.fixture(scope="module")
def parts() -> tuple[np.ndarray, np.ndarray]:
    """A part that turns and one that does not."""
    rng = np.random.default_rng(3)
    return 40 * rng.normal(size=len(NOLLS)), 20 * rng.normal(size=len(NOLLS))


def make(parts, angles=ANGLES, sense=1, covariance=None) -> Series:
    rotating, fixed = parts
    clean = np.array([fixed + turned(rotating, sense * angle) for angle in angles])
    each = np.eye(len(NOLLS)) if covariance is None else covariance
    return Series(NOLLS, angles, clean, np.broadcast_to(each, (len(angles), *np.shape(each)[-2:])))


@pytest.fixture(scope="module")
def correlated() -> np.ndarray:
    """A covariance per angle with correlations between all modes."""
    factors = 0.4 * np.random.default_rng(4).normal(size=(len(ANGLES), len(NOLLS), len(NOLLS)))
    return factors @ factors.mT + 4 * np.eye(len(NOLLS))


@pytest.mark.parametrize("sense", [1, -1])
def test_both_parts_come_back_from_a_noiseless_series(parts, sense):
    split = split_series(make(parts, sense=sense), sense)
    apart = split.separable
    assert np.allclose(split.rotating.zernike_nm[apart], parts[0][apart], atol=1e-8)
    assert np.allclose(split.fixed.zernike_nm[apart], parts[1][apart], atol=1e-8)
    assert split.chi2 < 1e-12


def test_of_symmetric_modes_only_the_sum_is_told(parts):
    split = split_series(make(parts), 1)
    assert np.array_equal(~split.separable, SYMMETRIC)
    assert np.allclose(split.unsplit.zernike_nm, np.where(SYMMETRIC, parts[0] + parts[1], 0), atol=1e-8)
    assert np.all(split.rotating.zernike_nm[SYMMETRIC] == 0)


@pytest.mark.slow
def test_errors_and_chi2_are_those_of_monte_carlo(parts, correlated):
    series = make(parts, covariance=correlated)
    roots = np.linalg.cholesky(correlated)
    rng = np.random.default_rng(5)
    pulls, chi2 = [], []
    for _ in range(TRIALS):
        noise = np.einsum("cij,cj->ci", roots, rng.normal(size=series.zernike_nm.shape))
        split = split_series(Series(NOLLS, ANGLES, series.zernike_nm + noise, correlated), 1)
        apart = split.separable
        pulls.append(
            [
                (part.zernike_nm - true)[apart] / part.sigma_nm[apart]
                for part, true in ((split.rotating, parts[0]), (split.fixed, parts[1]))
            ]
        )
        chi2.append(split.chi2_nu)
    scatter = np.std(pulls, axis=0)
    assert np.abs(scatter - 1).max() < 5 / np.sqrt(2 * TRIALS)
    assert abs(np.mean(chi2) - 1) < 0.02


def test_equal_errors_give_the_textbook_variance(parts):
    split = split_series(make(parts), 1)
    m = 2  # Noll 5 and 6
    spread = 1 - abs(np.exp(1j * m * np.radians(ANGLES)).mean()) ** 2
    assert split.rotating.sigma_nm[1:3] == pytest.approx(np.sqrt(1 / len(ANGLES) / spread))
    assert split.fixed.sigma_nm[1:3] == pytest.approx(np.sqrt(1 / len(ANGLES) / spread))


@pytest.mark.parametrize("sense", [1, -1])
def test_the_sense_of_rotation_is_found(parts, sense):
    best, other = try_both_senses(make(parts, sense=sense))
    assert best.sense == sense
    assert other.chi2 - best.chi2 > 1000


def test_the_angles_agree_when_turned_back_without_the_fixed_part(parts):
    series = make(parts)
    found = consistency(series, split_series(series, 1))
    assert found.without_fixed_nm < 1e-8
    assert found.measured_nm > 50
    assert found.expected_nm == pytest.approx(np.sqrt(2 * len(NOLLS)))
    turning_only = make((parts[0], np.zeros(len(NOLLS))))
    assert consistency(turning_only, split_series(turning_only, 1)).turned_back_nm < 1e-8


def test_pointing_and_incomplete_pairs_are_left_out():
    kept = usable_modes(range(2, 31), highest_noll=27)
    assert np.arange(2, 31)[~kept].tolist() == [2, 3, 27, 28, 29, 30]
    assert usable_modes(range(2, 31))[2:].all()
