"""docs/instruments.md: its example works, its reference lists every key."""

from __future__ import annotations

import re

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.pupil import petals_of, segments_of

PAGE = REPOSITORY / "docs/instruments.md"


def example():
    return re.search(r"```yaml\n(name:.*?)```", PAGE.read_text(), re.DOTALL)[1]


@pytest.fixture
def instrument(tmp_path):
    path = tmp_path / "example_4m.yaml"
    path.write_text(example())
    return load_instrument(path)


def test_the_example_is_the_telescope_that_the_page_describes(instrument):
    assert (petals_of(instrument.pupil).count, segments_of(instrument.pupil).count) == (3, 18)
    assert instrument.pupil.obstructions[0].placement.shift_m == pytest.approx((-1.1, 0.4))
    assert instrument.defaults["pixel_scale_mas"] == 17.6
    assert instrument.on("2021-01-01").defaults["pixel_scale_mas"] == 18.0
