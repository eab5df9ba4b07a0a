"""YAML is read strictly, lines are remembered; any text is settings or refused (property-based)."""

import os

import pytest
from helpers.patience import within
from hypothesis import example, given, settings
from hypothesis import strategies as st

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.yaml import load_yaml, parse_yaml

QUICK = settings(max_examples=100, deadline=None, derandomize=True, database=None)
TEXTS = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cn", "Co"]), max_size=20)
WORDS = st.sampled_from(
    ["off", "Yes", "010", "0x1F", "1:30", "1e5", "~", "null", ".5", "-", "2024-01-01", "<<", "="]
)
TEXT = """\
role: psf
diversity:
  zernike: {6: -170.0,
            7: 1e-3}
spectrum:
- wavelength_nm: 1600
- wavelength_nm: 1650
"""


def test_values_come_with_their_lines():
    data, lines = parse_yaml(TEXT, "f.yaml")
    assert data["diversity"]["zernike"] == {6: -170.0, 7: 1e-3}
    assert lines[("diversity",)] == 2
    assert lines[("diversity", "zernike", 7)] == 4
    assert lines[("spectrum", 1, "wavelength_nm")] == 7


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-2.5e+1", -25.0),
        ("1e", "1e"),
        ("0x1F", 31),
        ("010", 10),  # 8 in YAML 1.1
        ("1:30", "1:30"),  # 90 in YAML 1.1
        ("1_000", "1_000"),
        ("true", True),
        ("off", "off"),  # False in YAML 1.1
    ],
)
def test_numbers_and_booleans_are_those_of_yaml_1_2(text, value):
    """Truth: https://yaml.org/spec/1.2.2/#1032-tag-resolution, but for octal numbers, which are text."""
    read = parse_yaml(f"a: {text}", "f.yaml")[0]["a"]
    assert read == value and type(read) is type(value)


def test_a_pipe_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "f.yaml")
    with within(10), pytest.raises(ConfigurationError, match=r"f\.yaml: cannot be read: not a regular file"):
        load_yaml(tmp_path / "f.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: {c: 2,\n    c: 3}", r"f\.yaml:3: key 'c' is given twice \(first on line 2\)"),
        ("1: a\n1.0: b", r"f\.yaml:2: key '1.0' is given twice"),
        ("6: -170.0\n'6': 170.0", r"f\.yaml:2: key '6' is given twice \(first on line 1\)"),
        ("a: &a [*a]", r"f\.yaml:1: alias '\*a' is not accepted"),
        ("a: &x [1]\nb: *x", r"f\.yaml:2: alias '\*x' is not accepted"),
        ("a: !!python/object/apply:os.system [ls]", r"f\.yaml:1: tag .* is not accepted"),
        ("a: [1, 2\nb: 3", r"f\.yaml:2: not valid YAML"),
        ("? [a, b]\n: 1", r"f\.yaml:1: a key must be a plain word or number"),
        ("a: 1\n---\nb: 2", r"f\.yaml:2: not valid YAML"),
        ("a: \x00", r"f\.yaml:1: not valid YAML"),
        ("[" * 500, r"f\.yaml:1: nested more than 30 deep"),
        ("", r"f\.yaml:1: expected 'key: value' pairs, found nothing"),
    ],
)
def test_what_yaml_forgives_is_not_forgiven(text, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        parse_yaml(text, "f.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"a: \xff\xfe", "not a UTF-8 text file"), (b"#" * 5_000_000, "larger than 1 MB")],
)
def test_a_file_that_is_no_text_or_huge_is_refused(tmp_path, content, message):
    (tmp_path / "f.yaml").write_bytes(content)
    with pytest.raises(ConfigurationError, match=message):
        load_yaml(tmp_path / "f.yaml")


@pytest.mark.slow
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
