"""Sets of frames: lines of path and tag become the inputs of a recipe."""

import pytest
from conftest import invoke

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.recipe.sof import inputs_from, read_sof

FRAMES = [
    ("a.fits", "NCPA_CALIBRATION"),
    ("b.fits", "DEFOCUS_RAMP"),
    ("c.fits", "defocus_ramp"),
    ("d.fits", "DARK"),
]


def test_tags_find_their_input_and_darks_go_to_all():
    assert inputs_from(FRAMES, "full_reduction") == (
        "calibration=a.fits", "ramp=b.fits", "ramp=c.fits", "calibration=d.fits", "ramp=d.fits"
    )  # fmt: skip
    assert inputs_from(FRAMES[:1], "diagnose") == ("cube=a.fits",)
    assert inputs_from([("a.fits", "CUBE")], "diagnose") == ("cube=a.fits",)


def test_a_tag_that_the_recipe_has_no_input_for_is_an_error_that_says_what_there_is():
    with pytest.raises(ConfigurationError, match="no input for the tag 'DEFOCUS_RAMP'"):
        inputs_from(FRAMES, "ncpa_calibration")
    with pytest.raises(ConfigurationError, match="did you mean 'NCPA_CALIBRATION'"):
        inputs_from([("a.fits", "NCPA_CALIBRATON")], "ncpa_calibration")


def test_a_file_may_have_comments_blanks_and_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("RAW", "/raw")
    path = tmp_path / "n.sof"
    path.write_text("# night\n\n$RAW/a.fits   NCPA_CALIBRATION # best\nb.fits\tDARK\n")
    assert read_sof(path) == [("/raw/a.fits", "NCPA_CALIBRATION"), ("b.fits", "DARK")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ""),
        ("# nothing\n", ""),
        ("a.fits\n", ""),
        ("a b.fits PSF", ".*path with blanks stands in quotes"),
    ],
)
def test_a_file_without_frames_or_tags_is_bad_data(tmp_path, text, message):
    path = tmp_path / "n.sof"
    path.write_text(text)
    with pytest.raises(InputDataError, match=rf"n\.sof{message}"):
        read_sof(path)
    assert invoke("validate", "ncpa_calibration", "--sof", str(path)).exit_code == 3
