"""The commands that the README lists are executed, on a small run of stand-in stages."""

import re
import shlex

import pytest
from conftest import Bench, invoke
from helpers.paths import REPOSITORY
from test_docs import commands

README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
BLOCK = re.search(r"^## Commands\n\n(```sh\n.*?^```)", README, re.DOTALL | re.MULTILINE)
assert BLOCK is not None
LISTED = [" ".join(call) for call in commands(BLOCK[1], "irlos")]
# What needs more than a small run has tests of its own.
ELSEWHERE = {
    "explain": "tests/reference/test_explain.py",
    "score": "tests/report/test_score.py",
    "simulate": "tests/commands/test_cli_simulate.py",
    "night": "tests/commands/test_cli_night.py",
    "trend": "tests/night/test_trend.py",
    "focus": "tests/focus/test_command.py",
    "paper": "tests/paper/test_paper.py",
}
SAMPLE = REPOSITORY / "data_samples" / "ramp" / "offset_00" / "offset_00.fits"


def filled_in(call: str, bench: Bench) -> list[str]:
    """A call with names of what is there in place of those that the README leaves open."""
    names = {
        "DIR/03_calibrate.h5": f"{bench.output}/02_calibrate.h5",
        "DIR_A DIR_B": f"{bench.output} {bench.output}",
        "zernike_nm": "mean",
        "ncpa.csv": f"{bench.folder}/ncpa.csv",
        "RECIPE": str(bench.recipe),
        "FITS": f"{SAMPLE} --output -",
    }
    for name, value in names.items():
        call = re.sub(rf"(?<![\w/]){re.escape(name)}(?![\w/])", value, call)
    return shlex.split(re.sub(r"(?<![\w/])DIR(?![\w/])", str(bench.output), call))


@pytest.mark.parametrize("call", [call for call in LISTED if call.split()[0] not in ELSEWHERE])
def test_a_command_of_the_readme_works(bench, call):
    bench.run()
    result = invoke(*filled_in(call, bench))
    assert result.exit_code == 0, result.output


def test_the_others_have_tests_of_their_own():
    for name, file in ELSEWHERE.items():
        text = (REPOSITORY / file).read_text(encoding="utf-8")
        assert f'"{name}"' in text, f"{file} does not call irlos {name}"
    assert {call.split()[0] for call in LISTED} >= {
        *ELSEWHERE,
        "status",
        "show",
        "compare",
        "export",
        "report",
    }
