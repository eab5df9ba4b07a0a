"""README and docs agree with the program: commands parse, files exist, make knows the targets."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from itertools import pairwise, takewhile

import click
import jinja2
import pytest
import yaml
from helpers.paths import REPOSITORY

import irlos_pipe
from irlos_pipe.commands.main import cli
from irlos_pipe.files.shipped import RECIPES as RECIPE_FOLDER
from irlos_pipe.files.shipped import SIMULATIONS, named_file, shipped_names
from irlos_pipe.recipe import load_recipe

PAGES = sorted(
    [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md"), *REPOSITORY.glob("data_samples/*.md")]
)
RECIPES = sorted(REPOSITORY.glob("recipes/**/*.yaml"))
OWN_PROFILE = "instrument=my_camera.yaml"  # which docs/own_telescope.md writes and its test executes
FENCE = re.compile(r"^```\w*\n.*?^```", re.DOTALL | re.MULTILINE)
SHELL = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"^(?:    |#   )(irlos .*)", re.MULTILINE)
INLINE = re.compile(r"`([^`\n]+)`")
# A path of the source tree, not an example of the user's.
OF_THE_TREE = re.compile(r"(?:irlos_pipe|docs|recipes|tests|benchmarks|data_samples)/[\w./-]*")

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
each_text = pytest.mark.parametrize(
    "path", [*PAGES, *RECIPES], ids=lambda path: path.relative_to(REPOSITORY).as_posix()
)


def commands(text: str, program: str) -> Iterator[list[str]]:
    """Yield the arguments of every call of a program in blocks and in inline code."""
    text = re.sub(r"\s*\\\n#? *", " ", text)
    lines = [line for block in SHELL.findall(text) for line in block.splitlines()]
    for line in [*lines, *INDENTED.findall(text), *INLINE.findall(FENCE.sub("", text))]:
        if line.startswith(f"{program} "):
            yield list(takewhile(lambda word: word != ">", shlex.split(line, comments=True)[1:]))


def is_sketch(arguments: list[str]) -> bool:
    """Whether a command is named rather than spelt out: ``irlos run``, ``irlos run … --dry-run``."""
    return len(arguments) < 2 or any("…" in argument or "..." in argument for argument in arguments)


@each_text
def test_every_command_that_is_spelt_out_is_accepted(path):
    for arguments in commands(path.read_text(encoding="utf-8"), "irlos"):
        name, *rest = arguments
        command = cli.get_command(click.Context(cli), name)
        assert command is not None, f"irlos {name}"
        if not is_sketch(arguments):
            command.make_context(name, rest)


@each_text
def test_every_recipe_in_a_command_exists_and_takes_the_settings(path):
    for arguments in commands(path.read_text(encoding="utf-8"), "irlos"):
        recipes = [argument for argument in arguments if argument.startswith("recipes/")]
        given = [value for name, value in pairwise(arguments) if name == "--set"]
        settings = [value for value in given if value != OWN_PROFILE]
        assert [recipe for recipe in recipes if not (REPOSITORY / recipe).exists()] == []
        given = [value.split("=")[0] for name, value in pairwise(arguments) if name == "--input"]
        if (
            len(arguments) > 1
            and arguments[0] == "run"
            and arguments[1] in [*recipes, *shipped_names(RECIPE_FOLDER)]
        ):
            recipe = REPOSITORY / arguments[1] if recipes else arguments[1]
            sampled = "--samples" in arguments
            load_recipe(recipe, settings, [f"{name}={REPOSITORY}" for name in given], samples=sampled)
        elif arguments[0] == "simulate" and not is_sketch(arguments) and arguments[1].islower():
            named_file(arguments[1], SIMULATIONS)


@each_page
def test_every_link_and_every_file_of_the_tree_exists(page):
    text = page.read_text(encoding="utf-8")
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []
    named = [name for name in INLINE.findall(text) if OF_THE_TREE.fullmatch(name)]
    assert [name for name in named if not (REPOSITORY / name).exists()] == []


def test_the_conda_recipe_has_the_version_and_the_requirements_of_the_package():
    text = (REPOSITORY / "packaging" / "meta.yaml").read_text()
    recipe = yaml.safe_load(
        jinja2.Environment(undefined=jinja2.StrictUndefined).from_string(text).render(PYTHON="python")
    )
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert (recipe["package"]["name"], recipe["package"]["version"]) == (
        project["name"],
        irlos_pipe.__version__,
    )
    run = [line.split() for line in recipe["requirements"]["run"]]
    other_names = {"pytorch": "torch", "astropy-base": "astropy", "matplotlib-base": "matplotlib"}
    assert [f"{other_names.get(name, name)}{limits}" for name, limits in run] == [
        f"python{project['requires-python']}",
        *project["dependencies"],
    ]
