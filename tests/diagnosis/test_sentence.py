"""How a sentence lists names. Truth: by hand."""

import pytest

from irlos_pipe.diagnosis.sentence import _listed


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
