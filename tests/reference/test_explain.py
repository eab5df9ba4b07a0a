"""Everything that has a name can be looked up."""

import re

import pytest
from conftest import invoke
from helpers.paths import PACKAGE

from irlos_pipe.effects.catalogue import CATALOGUE
from irlos_pipe.product.product import Checks
from irlos_pipe.reference.lookup import all_entries, explain, overview
from irlos_pipe.stages import LIGHT_PATH, STAGES

NAMED = re.compile(r"Check\(\s*f?\"(?:\{prefix\})?([\w ]+)\"")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("calibrate", "max_chi2_nu"),
        ("calibrate.max_chi2_nu", "key of a recipe"),
        ("companion", "flux_ratio"),
        ("twin solution", "even modes"),
        ("wfe_nm", "unit: nm"),
        ("excess_noise_factor", "key of a side-car"),
        ("wavelength_nm", "≥ 100"),
    ],
)
def test_a_name_is_explained(name, expected):
    assert expected in explain(name)


def test_an_unknown_name_is_corrected():
    result = invoke("explain", "seeing_hallo")
    assert result.exit_code == 2 and "did you mean 'seeing_halo'?" in result.stderr


def test_every_stage_effect_check_and_key_is_there():
    entries = {(entry.kind, entry.name) for entry in all_entries()}
    assert {("stage", name) for name in LIGHT_PATH} | {("effect", name) for name in CATALOGUE} <= entries
    keys = {f"{name}.{key}" for name in LIGHT_PATH for key in STAGES[name].Config.model_fields}
    assert keys <= {name for kind, name in entries if kind == "key of a recipe"}
    assert all(entry.summary for entry in all_entries())
    assert all(f"  {name}  " in overview() for name in CATALOGUE)


def test_every_explanation_says_more_than_the_name():
    """A number without words of its own would be explained by nothing."""
    texts = {entry.name: entry.text.partition("\n")[0] for entry in all_entries()}
    words = {name: name.rpartition(".")[2].replace("_", " ").lower() for name in texts}
    assert [name for name, text in texts.items() if text.lower().rstrip(".") in ("", words[name])] == []


def declared(stage: str) -> Checks:
    return getattr(STAGES[stage], "CHECKS", {})


def test_every_check_of_a_stage_is_explained_and_its_limit_is_a_key():
    made = {name for path in (PACKAGE / "stages").rglob("*.py") for name in NAMED.findall(path.read_text())}
    limits = {(stage, name): key for stage in LIGHT_PATH for name, (_, key) in declared(stage).items()}
    assert made - {name for _, name in limits} == set()
    keys = {entry.name for entry in all_entries() if entry.kind == "key of a recipe"}
    assert {f"{stage}.{key}" for (stage, _), key in limits.items() if key} <= keys
