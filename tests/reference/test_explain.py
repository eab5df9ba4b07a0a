"""Everything that has a name can be looked up."""

import pytest
from conftest import invoke

from irlos_pipe.reference.lookup import explain


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("calibrate", "max_chi2_nu"),
        ("calibrate.max_chi2_nu", "key of a recipe"),
        ("companion", "flux_ratio"),
        ("twin solution", "even modes"),
        ("wfe_nm", "unit: nm"),
        ("excess_noise_factor", "key of a side-car"),
        ("wavelength_nm", "≥ 100"),
    ],
)
def test_a_name_is_explained(name, expected):
    assert expected in explain(name)


def test_an_unknown_name_is_corrected():
    result = invoke("explain", "seeing_hallo")
    assert result.exit_code == 2 and "did you mean 'seeing_halo'?" in result.stderr
