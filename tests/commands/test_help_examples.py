"""Examples in the help of a command name what is there. Truth: the recordings of the sample data."""

import re

from conftest import invoke
from helpers.paths import REPOSITORY


def test_the_example_of_an_export_names_a_recording_of_the_demonstration():
    names = re.findall(r"recordings/(\w+)/([\w-]+)/", invoke("export", "--help").output)
    assert names and all((REPOSITORY / "data_samples" / name).is_dir() for _, name in names)
