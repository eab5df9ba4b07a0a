"""Every test that docs/reliability.md names for a defect is there. Truth: the test files."""

import re

import pytest
from helpers.paths import REPOSITORY

ROWS = re.findall(
    r"^\| [A-Z]\d+ \| [^|]+ \| `([^`]+)`: ([^|]+) \|$",
    (REPOSITORY / "docs" / "reliability.md").read_text(),
    re.MULTILINE,
)


def test_there_is_a_row_for_every_defect():
    assert len(ROWS) >= 52


@pytest.mark.parametrize(("path", "sentence"), ROWS)
def test_the_test_of_a_defect_is_where_the_page_says(path, sentence):
    name = f"def test_{sentence.strip().replace(' ', '_')}("
    assert name in (REPOSITORY / path).read_text(), f"{path} has no {name}"
