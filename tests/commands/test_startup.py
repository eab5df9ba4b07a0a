"""Commands that compute nothing do not wait for the libraries that compute."""

import json
import subprocess
import sys

import pytest
from conftest import invoke
from helpers import sparta_files
from helpers.paths import REPOSITORY

from irlos_pipe.commands.main import cli

LARGE = ("torch", "matplotlib", "scipy.stats", "scipy.signal")
# Commands that compute, simulate or draw; all others start without any of the large libraries.
MAY_LOAD = {"run", "reduce", "demo", "report", "score", "simulate", "paper", "night", "focus"}
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


def _loaded_by(calls: list[list[str]]) -> dict[str, list[str]]:
    code = CODE.replace("{large}", repr(LARGE))
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(calls)], capture_output=True, text=True, cwd=REPOSITORY
    )
    return {name: large for name, _, large in map(json.loads, done.stdout.splitlines())}


def test_every_command_either_computes_or_starts_at_once():
    assert set(QUICK) | MAY_LOAD == set(cli.commands)


@pytest.mark.parametrize("name", ["--version", "--help", *QUICK, "run", "night"])
def test_a_command_that_computes_nothing_loads_nothing_large(loaded, name):
    """A library once loaded stays: the first command to fail is it."""
    assert loaded[name] == []


@pytest.mark.slow
def test_what_is_up_to_date_is_found_to_be_so_without_anything_large(tmp_path):
    """Runs of every hour, by cron, find nothing to do most of the time."""
    recipe, data, run = tmp_path / "recipe.yaml", tmp_path / "data", tmp_path / "run"
    sparta_files.write_recorder(data / "sky", sparta_files.counts(sparta_files.star(24, 24), frames=3))
    recipe.write_text("recipe: test\ninputs: {cube: data}\nstages: [ingest]\n")
    config = tmp_path / "night.yaml"
    config.write_text(f"recipes: {{calibration: [{recipe}]}}\n")
    night = ["night", str(data), "--output", str(tmp_path / "tree"), "--config", str(config)]
    calls = [["run", str(recipe), "--output", str(run), "-q"], night]
    for call in calls:
        assert invoke(*call).exit_code == 0
    assert all(not large for large in _loaded_by(calls).values())


@pytest.mark.slow
def test_a_plan_for_data_that_nobody_touched_opens_none_of_them(tmp_path):
    """Of a run whose settings changed since, and what reads no recording anyway: astropy is not loaded."""
    data, recipe, run = tmp_path / "data", tmp_path / "recipe.yaml", tmp_path / "run"
    sparta_files.write_recorder(data / "sky", sparta_files.counts(sparta_files.star(24, 24), frames=3))
    recipe.write_text("recipe: test\ninputs: {cube: data}\nstages: [ingest]\n")
    assert invoke("run", str(recipe), "--output", str(run), "-q").exit_code == 0
    resolved = run / "recipe.resolved.yaml"
    resolved.write_text(resolved.read_text().replace("seed: 0", "seed: 1"))
    calls = [["validate", "full_reduction"], ["explain", "gap"], ["status", str(run)]]
    calls.append(["run", str(recipe), "--output", str(run), "--dry-run"])
    code = (
        "import json, sys; from click.testing import CliRunner; from irlos_pipe.commands.main import cli\n"
        f"codes = [CliRunner().invoke(cli, call).exit_code for call in {calls!r}]\n"
        "sys.exit('astropy' in sys.modules or any(codes))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY).returncode == 0
