"""Stage `modes` on cubes made with the pipeline's own model. Truth: the modes put in, and arithmetic."""

import numpy as np
import pytest
from helpers import series_bench as bench

from irlos_pipe.stages import modes as modes
from irlos_pipe.stages.calibrate import stage as calibrate

ANGLES = (0.0, 50.0, 120.0)
NUMBERS = (6, 10, 15, 21)
EACH = {"input": "cube", "each": True, "highest_noll": 21, "prior_scale": None}


@pytest.fixture(scope="module")
def products() -> dict:
    """Three cubes with different wavefronts of 12 modes, 20 modes estimated."""
    recordings = [bench.recording(f"at_{angle:.0f}", angle, seed) for seed, angle in enumerate(ANGLES)]
    found = {"ingest": bench.ingest_product(recordings)}
    return found | {"calibrate": bench.run_stage(calibrate, found, **EACH)[1]}


@pytest.fixture(scope="module")
def output(products):
    return bench.run_stage(modes, products, numbers=NUMBERS, cubes=2)[0]


@pytest.mark.slow
def test_the_scatter_is_the_rms_over_the_cubes(output):
    noll, std = (output.arrays[name].value for name in ("noll", "std_nm"))
    for mode in bench.NOLLS:
        true = np.sqrt(np.mean([bench.static_nm(angle)[mode] ** 2 for angle in ANGLES]))
        assert std[list(noll).index(mode)] == pytest.approx(true, abs=1.0)
    assert output.results.draws == 3


@pytest.mark.slow
def test_modes_that_were_not_put_in_are_noise(output):
    noll, std, noise = (output.arrays[name].value for name in ("noll", "std_nm", "noise_nm"))
    absent = noll > 15
    assert np.sqrt(np.mean((std / noise)[absent] ** 2)) == pytest.approx(1, abs=0.5)


@pytest.mark.slow
def test_unseen_frames_recommend_the_number_put_in(output):
    numbers = output.results.numbers
    assert numbers.recommended == 15
    place = NUMBERS.index(15)
    assert numbers.change_nm[place] == 0
    assert numbers.change_nm[0] > 20 * numbers.halves_nm[place]
    assert numbers.cubes == 2
    assert output.arrays["numbers/misfit"].value.shape[:2] == (2, len(NUMBERS))


@pytest.mark.parametrize("numbers", [(15,), (21, 15), (15, 15), (3, 15), (15, 300)])
def test_numbers_rise_and_are_those_of_modes(numbers):
    with pytest.raises(ValueError, match="at least two rising numbers"):
        modes.Config(numbers=numbers)
