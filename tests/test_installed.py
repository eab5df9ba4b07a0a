"""The package as it is installed, without the source tree, holds what the commands need."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import RECIPES, REPOSITORY

pytestmark = pytest.mark.slow

PLANNED = (
    "from irlos_pipe.recipe import load_recipe\n"
    "recipe = load_recipe('full_reduction', samples=True)\n"
    "print(recipe.path, *(path for paths in recipe.inputs.values() for path in paths), recipe.notice)"
)


def run(folder: Path, *arguments: object, **variables: object) -> str:
    environment = os.environ | {name: str(value) for name, value in variables.items()}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    ).stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Folder with the package as a wheel holds it."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("setuptools is too old to build the package")
    folder = tmp_path_factory.mktemp("installed")
    build = ("build", "--build-base", folder / "build", "--build-lib", folder / "site")
    run(REPOSITORY, "setup.py", "-q", "egg_info", "--egg-base", folder, *build)
    return folder / "site"


def test_recipes_go_by_name_and_samples_are_there(installed, tmp_path):
    out = run(tmp_path, "-c", PLANNED, PYTHONPATH=installed)
    assert out.count(f"{installed}/irlos_pipe/shipped/") == 3 and "simulated sample" in out
    listed = run(tmp_path, "-m", "irlos_pipe", "recipes", PYTHONPATH=installed)
    assert all(f"\n{path.stem} " in listed for path in RECIPES.glob("*.yaml"))


def test_everything_that_is_read_at_run_time_is_there(installed):
    there = {path.relative_to(installed).as_posix() for path in installed.rglob("*") if path.is_file()}
    package = [path for path in (REPOSITORY / "irlos_pipe").rglob("*") if path.suffix not in ("", ".pyc")]
    needed = [path.relative_to(REPOSITORY).as_posix() for path in package if path.is_file()]
    needed += [
        f"irlos_pipe/shipped/{path.relative_to(REPOSITORY).as_posix()}" for path in RECIPES.rglob("*.yaml")
    ]
    assert [path for path in needed if path not in there] == []
