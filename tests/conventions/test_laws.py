"""The laws whose numbers an instrument's profile states."""

import pytest

from irlos_pipe.conventions.laws import NcpaLaw, ResidualLaw


def test_an_ncpa_law_starts_at_amplitude_and_plateau_and_ends_at_the_plateau():
    law = NcpaLaw(70.0, 0.2, 10.0)
    assert law.sigma_nm([2, 7, 200]) == pytest.approx([80.0, 70.0 / 2.718281828459045 + 10.0, 10.0])


def test_a_residual_law_is_a_line_over_the_seeing():
    assert ResidualLaw(104.27, 58.6).wfe_nm(0.5) == pytest.approx(110.735)
