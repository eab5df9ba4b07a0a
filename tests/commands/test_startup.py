"""Commands that compute nothing do not wait for the libraries that compute."""

import json
import subprocess
import sys

import pytest
from conftest import invoke
from helpers import sparta_files
from helpers.paths import REPOSITORY

pytestmark = pytest.mark.xdist_group("startup")  # its fixtures serve all tests

LARGE = ("torch", "matplotlib", "scipy.stats", "scipy.signal")
SAMPLE = "data_samples/ramp/offset_00/offset_00.fits"
QUICK = {
    "validate": ["validate", "full_reduction", "--samples"],
    "recipes": ["recipes"],
    "explain": ["explain", "seeing_halo"],
    "sidecar": ["sidecar", SAMPLE, "--output", "-"],
    "status": ["status", "RUN"],
    "show": ["show", "RUN/01_ingest.h5"],
    "compare": ["compare", "RUN", "RUN"],
    "export": ["export", "RUN/01_ingest.h5", "--list"],
    "trend": ["trend", "RUN"],
}
PLANS = [
    ["run", "full_reduction", "--samples", "--output", "RUN", "--dry-run"],
    ["night", "data_samples", "--output", "RUN", "--dry-run"],
]
CODE = """
import json, sys
from click.testing import CliRunner
from irlos_pipe.commands.main import cli
for arguments in json.loads(sys.argv[1]):
    result = CliRunner().invoke(cli, arguments)
    loaded = [name for name in {large} if name in sys.modules]
    print(json.dumps([arguments[0], repr(result.exception), loaded]))
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> dict[str, list[str]]:
    """By command, in one process: the large libraries that are there after it."""
    run = str(tmp_path_factory.mktemp("run"))
    calls = [[one.replace("RUN", run) for one in call] for call in ([], ["--help"], *QUICK.values(), *PLANS)]
    calls[0] = ["--version"]
    return _loaded_by(calls)


def _loaded_by(calls: list[list[str]], large: tuple[str, ...] = LARGE) -> dict[str, list[str]]:
    code = CODE.replace("{large}", repr(large))
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(calls)], capture_output=True, text=True, cwd=REPOSITORY
    )
    return {name: large for name, _, large in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("name", ["--version", "--help", *QUICK, "run", "night"])
def test_a_command_that_computes_nothing_loads_nothing_large(loaded, name):
    """A library once loaded stays: the first command to fail is it."""
    assert loaded[name] == []


@pytest.mark.slow
def test_what_is_up_to_date_or_only_planned_is_found_to_be_so_without_anything_large(tmp_path):
    """Runs of every hour, by cron, find nothing to do most of the time; a plan opens no recording."""
    recipe, data, run = tmp_path / "recipe.yaml", tmp_path / "data", tmp_path / "run"
    sparta_files.write_recorder(data / "sky", sparta_files.counts(sparta_files.star(24, 24), frames=3))
    recipe.write_text("recipe: test\ninputs: {cube: data}\nstages: [ingest]\n")
    config = tmp_path / "night.yaml"
    config.write_text(f"recipes: {{calibration: [{recipe}]}}\n")
    night = ["night", str(data), "--output", str(tmp_path / "tree"), "--config", str(config)]
    again = ["run", str(recipe), "--output", str(run), "-q"]
    for call in (again, night):
        assert invoke(*call).exit_code == 0
    assert not any(_loaded_by([again, night]).values())
    plans = [["validate", "full_reduction"], ["explain", "gap"], ["status", str(run)]]
    plans.append([*again[:-1], "--seed", "1", "--dry-run"])
    assert not any(_loaded_by(plans, ("astropy",)).values())
