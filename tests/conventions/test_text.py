"""Pieces of text for people; truth: written out by hand."""

import pytest

from irlos_pipe.conventions.text import rounded_by_error

NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "error", "pattern", "expected"),
    [
        (0.0188, 0.0006, ".2%", "1.880 ± 0.060 %"),
        (0.0188, NAN, ".2%", "1.88%"),
        (4.0, 0.0, ".1f", "4.0"),
        (-12.345, 0.23, "+.0f", "-12.35 ± 0.23"),
        (12.345, 0.23, "+.0f", "+12.35 ± 0.23"),
        (12345.0, 678.0, ".0f", "12340 ± 680"),
    ],
)
def test_a_value_has_the_digits_that_its_error_allows(value, error, pattern, expected):
    assert rounded_by_error(value, error, pattern) == expected
