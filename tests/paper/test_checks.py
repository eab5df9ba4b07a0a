"""What the experiments have to keep: checks are kept by some numbers and missed by others.

The committed numbers are changed in one place; limits and what is beyond them are written by hand.
"""

import math

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.product.product import Check, Product
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import judged
from maintenance.paper_tables import read_tables

FILES = {"derotator_series": "derotator"}


def tables(stage: str) -> dict:
    return read_tables(REPOSITORY / "docs/paper" / f"{FILES.get(stage, stage)}.csv")


def missed(stage: str, found: dict) -> set[str]:
    return {check.name for check in STAGES[stage].checks(found) if not check.passed}


@pytest.mark.parametrize(
    ("stage", "table", "where", "column", "kept", "beyond", "check"),
    [
        # RMS of the pulls of three ramps: √(16.27 / 3) = 2.33 by χ² with a chance of 1e-3.
        ("first_tests", "ramps", "target == 'target_1' and variant == 'default_3'", "stage_sigma_nm", 1e3,
         0.01,
         "pull of the focus stage's error, target 1"),
        ("first_tests", "starts", "target == 'target_2' and variant == 'default_3' and start == 'default'",
         "wrong", 0, 1, "frames in a wrong minimum, target 2"),
        # Three standard errors of 30 nm and 100 cubes are 9 nm.
        ("methods", "conditions", "shape == 'power_law' and seeing_arcsec == 0.35", "introduced_nm", 150.0,
         152.0,
         "introduced NCPAs, power_law, 0.35 arcsec"),
        ("methods", "conditions", "shape == 'power_law' and seeing_arcsec == 0.35", "speckle_floor_nm",
         1.0, 0.0,
         "default over the floor of the speckles, power_law, 0.35 arcsec"),
        ("methods", "conditions", "shape == 'aliasing' and seeing_arcsec == 1", "ratio_to_dip_global",
         0.33, 0.34,
         "default over DIP global, aliasing, 1 arcsec"),
        ("correction_gain", "stars", "seeing_arcsec == 1", "dip_global", 0.56, 0.4,
         "gain in Strehl ratio by DIP global, 1 arcsec"),
        ("correction_gain", "stars", "seeing_arcsec == 1", "dip_global", 0.57, 0.58,
         "Strehl ratio by the default over that by DIP global, 1 arcsec"),
        ("focus_ramp", "ways", "key == 'default_3'", "true_rms_nm", 3.9, 4.1,
         "defocus error, default: NCPAs, AO residual, jitter as calibrated, 3 modes"),
        ("focus_ramp", "ways", "key == 'default_9'", "slope", 1.02, -1.0,
         "slope, default: NCPAs, AO residual, jitter as calibrated, 9 modes"),
        ("focus_ramp", "ways", "key == 'none_9'", "true_rms_nm", 5.1, 4.9,
         "error with NCPAs over that without, NCPAs by DIP global, kernel 12 mas, 9 modes"),
        ("ramp_conditions", "ways", "condition == 'clean' and way == 'default'", "true_rms_nm", 3.9, 4.1,
         "defocus error, ramp with nothing"),
        ("exposures", "methods", "method == 'long_exposure' and exposure_s == 0.02", "modes_nm", 1.5, 0.5,
         "default's worst over its best exposure, 0.35 arcsec"),
        ("ranking", "methods", "fitted == 'open' and seeing_arcsec == 1 and tail_nm == 0", "error_nm", 28, 29,
         "default over the best of the others, 1 arcsec, tail 0 nm"),
        ("derotator_series", "methods", "method == 'long_exposure'", "fixed_error_nm", 1.0, 9.0,
         "error over quoted error, fixed part"),
        ("mirror_loop", "loops", "diversity == 'mirror' and bias_nm == 200", "cut_off", 0, 1,
         "loops cut off, mirror diversity, bias 200 nm"),
        ("mirror_loop", "loops", "method == 'long_exposure' and diversity == 'exact' and bias_nm == 0",
         "worst_nm",
         9.9, 10.1, "Noll 4–30 left, bias 0 nm"),
        ("faint", "curves", "exposure_s == 1 and key == 'default_3'", "limit_mag", 21.0, 10.0,
         "magnitudes that three modes reach further than nine, default, 1 s"),
        ("faint", "curves", "exposure_s == 1 and key == 'default_3'", "bright_error_nm", 1.0, 9.0,
         "error of the brightest star over theory, default, 1 s"),
        ("mode_statistics", "laws", "modes == 'Noll 4–51' and name == 'introduced'", "A_nm", None, 9e3,
         "law of the default, term A: deviation over standard error"),
        ("mode_number", "curves", "method == 'dip_global' and highest_noll == 61", "median_nm", 90.0, 0.1,
         "modes from those introduced to DIP global's best, m_J 7"),
        ("mode_number", "cubes", "sample in ['cube 0', 'cube 1', 'cube 2']", "recommended_noll", 51, 61,
         "cubes whose held-out frames choose another number than the introduced one"),
        ("capture", "starts", "bands == 'J+H' and start == 'default'", "required_captured", None, 959,
         "defocus not found within the required range"),
        ("slow_loop", "loops", "sensor == 'long_exposure' and mag_j == 12", "predicted_nm", 10.0, 1.0,
         "residual over prediction"),
        ("seeing_scales", "distributions", "quantity == 'sparta_arcsec'", "median", 0.56, 0.6,
         "SPARTA's median seeing over that of the relation"),
    ],
)  # fmt: skip
def test_a_number_beyond_its_limit_is_missed(stage, table, where, column, kept, beyond, check):
    found = tables(stage)
    rows = found[table].query(where, engine="python").index
    assert len(rows)
    if kept is not None:
        found[table].loc[rows, column] = kept
    assert check not in missed(stage, found)
    found[table].loc[rows, column] = beyond
    assert check in missed(stage, found)


@pytest.mark.parametrize(
    ("faint_nm", "diverged", "kept"),
    [(19.0, 0, True), (21.0, 0, False), (math.nan, 0, False), (99.0, 4, True)],
)
def test_a_loop_that_leaves_more_than_the_2x2_mode_on_any_star_is_missed(faint_nm, diverged, kept):
    found = tables("slow_loop")
    loops = found["loops"]
    for sensor, residual_nm in (("long_exposure", 10.0), ("centroids_2x2", 12.0)):
        loops.loc[loops.sensor == sensor, "residual_nm"] = residual_nm
    loops.loc[(loops.sensor == "long_exposure") & (loops.mag_j == 19), "residual_nm"] = faint_nm
    loops.loc[(loops.sensor == "centroids_2x2") & (loops.mag_j == 19), ["residual_nm", "diverged"]] = (
        20.0,
        diverged,
    )
    assert ("residual over that of the 2x2 centroids" not in missed("slow_loop", found)) is kept


def product(stage: str, results: dict) -> Product:
    return Product(stage, {}, results, [Check("old", 1.0, "", None, 2.0, "")])


def test_numbers_of_an_experiment_are_judged_by_the_checks_of_today_and_others_by_their_own():
    records = {name: table.to_dict("records") for name, table in tables("seeing_scales").items()}
    old = product("seeing_scales", {"tables": records})
    assert [check.name for check in judged(STAGES["seeing_scales"], old)] != ["old"]
    assert [check.name for check in judged(STAGES["calibrate"], product("calibrate", {}))] == ["old"]
