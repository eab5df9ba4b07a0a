"""Tables of the experiments. Truth: numbers by hand, Monte Carlo, standard errors of normal values."""

import numpy as np
import pytest

from irlos_pipe.paper.common.table import (
    csv_of_tables,
    median_in_range,
    rms_in_range,
)
from maintenance.paper_tables import read_tables


def test_the_range_of_an_rms_holds_it_and_closes_on_equal_values():
    assert list(rms_in_range("x", [3.0, -3.0, 3.0]).values()) == pytest.approx((3, 3, 3))
    wide = rms_in_range("x", np.random.default_rng(1).normal(0, 2.0, 4000))
    # standard error of an RMS of n normal values: sigma / sqrt(2 n)
    assert (wide["x_high"] - wide["x_low"]) / 2 == pytest.approx(1.645 * 2.0 / np.sqrt(8000), rel=0.1)


def test_the_range_of_a_median_holds_where_values_are_normal():
    # 90 % of such ranges hold the true median, 0; of 400 trials 90 ± 4.5 % at three standard errors.
    rng = np.random.default_rng(3)
    found = [median_in_range("x", rng.standard_normal(25)) for _ in range(400)]
    assert np.mean([one["x_low"] <= 0 <= one["x_high"] for one in found]) == pytest.approx(0.9, abs=0.06)


def test_csv_keeps_every_digit_and_kind(tmp_path):
    rows = [{"n": 3, "x": 0.1 + 0.2, "good": True, "text": "a, b", "none": None}, {"n": 4, "x": 1e-300}]
    path = tmp_path / "one.csv"
    path.write_text(csv_of_tables({"first": rows, "second": [{"m": 1.0}]}))
    found = read_tables(path)
    assert found["first"].x.tolist() == [0.1 + 0.2, 1e-300]
    assert found["first"].n.dtype.kind == "i" and found["first"].text[0] == "a, b"
    assert found["first"].none.isna().all() and found["second"].m[0] == 1.0
