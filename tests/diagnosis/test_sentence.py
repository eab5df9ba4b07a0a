"""How a sentence lists names and describes what is left. Truth: by hand."""

import pytest

from irlos_pipe.diagnosis.rest import Rest
from irlos_pipe.diagnosis.verdict import _listed


@pytest.mark.parametrize(
    ("phrases", "said"),
    [
        (["a ghost of 1 %"], "a ghost of 1 %"),
        (["a ghost", "a spot"], "a ghost and a spot"),
        (
            ["a ghost at 9 mas, PA 3°", "a spot", "bad pixels"],
            "a ghost at 9 mas, PA 3°; a spot; and bad pixels",
        ),
    ],
)
def test_three_names_or_more_are_told_apart(phrases, said):
    assert _listed(phrases) == said


@pytest.mark.parametrize(
    ("finer", "flat_rms", "said"),
    [
        (
            True,
            0.0049,
            "partly finer than the diffraction limit as an error of the flat of 0.49% RMS",
        ),
        (True, 0.0, "static, partly finer than the diffraction limit"),
        (False, 0.0049, "static"),
    ],
)
def test_what_is_finer_than_the_telescope_makes_has_the_size_of_the_flats_error(finer, flat_rms, said):
    rest = Rest(0.006, 5.0, 6.0, 24.0, True, "one-sided", "static", finer, flat_rms)
    assert said in rest.text
    assert ("flat" in rest.text) == (finer and flat_rms > 0)
