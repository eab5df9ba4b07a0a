"""Offsets of a mirror's modes. Truth: tables whose best fit is known by hand; Monte Carlo for the errors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import optics_cases as cases

from irlos_pipe.estimate.mirror_modes import mirror_offsets
from irlos_pipe.optics.wavefront import clear_pupil, opd_maps_nm

SAMPLES = 64
LIT = clear_pupil(cases.FACILITY.pupil, SAMPLES)
NOLLS = list(range(2, 22))
EVERYWHERE = np.ones_like(LIT)
RNG = np.random.default_rng(7)
WAVEFRONT_NM = 30 * RNG.standard_normal(len(NOLLS))
ROOT = RNG.standard_normal((len(NOLLS), len(NOLLS)))
COVARIANCE_NM2 = ROOT @ ROOT.T


def table(mixture: np.ndarray) -> np.ndarray:
    """Maps of mixtures of Noll 4 to 21, (modes, Noll modes)."""
    return opd_maps_nm(range(4, 22), mixture, EVERYWHERE)


def offsets(maps_nm: np.ndarray, gain: float = 1.0):
    return mirror_offsets(maps_nm, NOLLS, WAVEFRONT_NM, COVARIANCE_NM2, LIT, gain)


def test_a_table_of_mixed_polynomials_makes_the_same_wavefront():
    """As many independent mixtures as polynomials are another basis of the same wavefronts."""
    mixture = RNG.standard_normal((18, 18))
    found = offsets(table(mixture))
    assert found.value @ mixture == pytest.approx(-WAVEFRONT_NM[2:], rel=1e-6)
    assert found.after_nm < 1e-6 * found.before_nm


def test_errors_are_those_of_the_wavefront():
    mixture = RNG.standard_normal((18, 18))
    drawn = RNG.multivariate_normal(WAVEFRONT_NM, COVARIANCE_NM2, size=4000)
    maps_nm = table(mixture)
    scatter = np.std(
        [mirror_offsets(maps_nm, NOLLS, one, COVARIANCE_NM2, LIT).value for one in drawn[:400]], axis=0
    )
    assert scatter == pytest.approx(offsets(maps_nm).sigma, rel=0.2)


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


@pytest.mark.parametrize("twice", [np.eye(18)[[0, 1, 0]], np.vstack([np.eye(18)[:2], np.zeros(18)])])
def test_modes_that_depend_on_one_another_are_refused(twice):
    with pytest.raises(ValueError, match="3 modes are only 2 different shapes"):
        offsets(table(twice))


def test_holes_outside_the_pupil_are_no_matter_and_inside_they_are_refused():
    maps_nm = table(np.eye(18))
    outside = np.where(LIT, maps_nm, np.nan)
    assert offsets(outside).value == pytest.approx(offsets(maps_nm).value)
    maps_nm[3, SAMPLES // 4, SAMPLES // 4] = np.nan
    with pytest.raises(ValueError, match="not a number"):
        offsets(maps_nm)
