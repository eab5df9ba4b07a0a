"""Experiments on the strength and the number of the modes. Truth: the simulator, and what was made up."""

import numpy as np
import pytest
from helpers.experiment_stage import run_on, sample, tables_of

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper import mode_number, mode_statistics
from irlos_pipe.paper.mode_statistics import INTRODUCED, beyond_nm

FACILITY = load_instrument("irlos").facility
NOLLS = np.arange(2, 62)
ERROR_NM = {"long_exposure": 1.0, "dip_global": 20.0}


@pytest.mark.slow
def test_fifty_modes_are_introduced_and_the_default_hardly_sees_others():
    sizes = {"frames": 32, "published_frames": 2, "highest_noll": 61}
    default, published = mode_statistics.rows(sample(mode_statistics, (3, 0), FACILITY, sizes))
    assert np.all((default["introduced_nm"] != 0) == (NOLLS <= INTRODUCED))
    found, other = (beyond_nm(NOLLS, np.abs(row["zernike_nm"])) for row in (default, published))
    assert found < min(3, 0.5 * other)


def drawn_modes(star):
    """Modes of the law, fifty of them introduced, with noise."""
    rng, nolls = np.random.default_rng(star.seed), np.arange(2, star.sizes.highest_noll + 1)
    law = 60 * np.exp(-0.15 * (nolls - 2)) + 8
    introduced = np.where(nolls <= 51, law * rng.normal(size=len(nolls)), 0.0)
    for method, error in ERROR_NM.items():
        noise = error * rng.normal(size=len(nolls))
        own = {"sigma_nm": np.full(len(nolls), error), "error_nm": np.linalg.norm(noise[2:]), "chi2_nu": 1.0}
        yield {"method": method, "introduced_nm": introduced, "zernike_nm": introduced + noise, **own}


def test_the_law_of_the_introduced_modes_is_found_and_noise_makes_a_plateau(monkeypatch):
    statistics = run_on(monkeypatch, mode_statistics, drawn_modes, cubes=40)
    laws = tables_of(statistics)["laws"].set_index(["modes", "name"])
    law = laws.loc[("Noll 4–51", "introduced")]
    assert abs(law.A_nm - 60) < 3 * law.A_sigma_nm
    assert abs(law.B - 0.15) < 3 * law.B_sigma
    assert abs(law.C_nm - 8) < 3 * law.C_sigma_nm
    assert laws.C_nm[("all from Noll 4 on", "dip_global")] == pytest.approx(np.hypot(20, 5), rel=0.15)


@pytest.mark.long
def test_the_introduced_number_beats_fewer_and_unseen_frames_recommend_it():
    sizes = {"frames": 32, "published_frames": 2, "numbers": (31, 51), "magnitudes": (7.0, 16.0)}
    rows = list(mode_number.rows(sample(mode_number, (3, 0), FACILITY, sizes, read=None)))
    error_nm = {(row["method"], row["mag_j"], row["highest_noll"]): row.get("error_nm") for row in rows}
    assert error_nm["long_exposure", 7.0, 51] < 0.5 * error_nm["long_exposure", 7.0, 31]
    assert error_nm["lift_avg", 16.0, 51] > error_nm["lift_avg", 7.0, 51]
    few, right = (row for row in rows if row["method"] == mode_number.HELD_OUT)
    assert right["recommended_noll"] == 51 and few["held_out_chi2_nu"] > right["held_out_chi2_nu"]
