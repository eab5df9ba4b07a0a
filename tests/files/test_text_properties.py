"""Texts of any letters: settings survive writing and reading, no line steers a terminal (property-based)."""

from hypothesis import example, given, settings
from hypothesis import strategies as st

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.yaml import parse_yaml, yaml_text

QUICK = settings(max_examples=100, deadline=None, derandomize=True, database=None)
TEXTS = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cn", "Co"]), max_size=20)
WORDS = st.sampled_from(
    ["off", "Yes", "010", "0x1F", "1:30", "1e5", "~", "null", ".5", "-", "2024-01-01", "<<", "="]
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXTS | WORDS,
    lambda below: st.lists(below, max_size=3) | st.dictionaries(TEXTS | WORDS, below, max_size=3),
    max_leaves=8,
)


@QUICK
@given(st.dictionaries(TEXTS | WORDS, VALUES, max_size=4))
def test_settings_are_read_as_they_were_written(content):
    assert parse_yaml(yaml_text(content), "f.yaml")[0] == content


@QUICK
@given(st.text(max_size=60) | st.lists(WORDS | TEXTS, max_size=6).map(": ".join))
@example("a: 9" + "9" * 5000)
def test_any_text_is_read_or_refused_in_one_line(text):
    try:
        parse_yaml(text, "f.yaml")
    except ConfigurationError as error:
        assert "\n" not in str(error)


@QUICK
@given(st.text(st.characters(exclude_categories=[]), max_size=40))
def test_a_line_for_people_holds_nothing_that_steers_a_terminal(text):
    shown = printable(text)
    assert shown.isprintable() and (shown == text) == text.isprintable()
    shown.encode("utf-8")
