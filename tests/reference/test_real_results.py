"""Small runs of every stage of the light path: their schema, their arrays, and that they repeat to the bit.

Truth of the bits: the same recipe run with one job, and another process. Numbers of modes, frames and draws
are small, the code is that of a full reduction.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
from helpers import sparta_files
from helpers.result_schema import schema_problems
from threadpoolctl import threadpool_limits

from irlos_pipe.pipeline import Resources, run_recipe
from irlos_pipe.product.product import Product, name_in
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import load_recipe
from irlos_pipe.reference import COMMANDS, RESULTS
from irlos_pipe.stages import LIGHT_PATH, STAGES
from maintenance.schema import commands_schema, results_schema, text_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("results")]  # its fixtures take long

RAMP = """\
recipe: ramp
inputs: {calibration: data/cube_0, ramp: data/ramp}
stages: [ingest, prior, calibrate, lift, sensitivity, correct]
seed: 5
model: {pupil_samples: 48}
calibrate: {method: long_exposure, highest_noll: 6, max_iterations: 3, compare: [dip_avg]}
lift: {start: zero, max_iterations: 3}
sensitivity: {faintest_mag_j: 9.5, realisations: 2, modes: [[2, 3, 4]], calibrated: [true]}
"""
CUBES = """\
recipe: cubes
inputs: {cube: [data/cube_0, data/cube_1]}
stages: [ingest, calibrate, derotator, modes]
model: {pupil_samples: 48}
calibrate: {input: cube, each: true, method: dip_avg, highest_noll: 8, max_iterations: 3}
modes: {numbers: [4, 6]}
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> list[Path]:
    """Folders of runs that together hold every stage but `diagnose`."""
    folder = tmp_path_factory.mktemp("small")
    for number, angle in enumerate((0.0, 90.0)):
        adu = sparta_files.counts(sparta_files.star(16, 16), 8, seed=number)
        keys = {"derotator_angle_deg": angle}
        sparta_files.write_recorder(folder / "data" / f"cube_{number}", adu, keys=keys)
    for number, offset in enumerate((-60.0, 0.0, 60.0)):
        adu = sparta_files.counts(sparta_files.star(16, 16), frames=1, seed=number)
        keys = {"role": "defocus_ramp", "introduced_defocus_nm": offset}
        sparta_files.write_recorder(folder / "data" / "ramp" / f"offset_{number}", adu, keys=keys)
    for name, text in {"ramp": RAMP, "cubes": CUBES}.items():
        (folder / f"{name}.yaml").write_text(text)
        run_recipe(load_recipe(folder / f"{name}.yaml"), folder / name, resources=Resources(report=False))
    return [folder / "ramp", folder / "cubes"]


def test_the_shipped_schemas_are_those_of_the_models():
    for file, schema in ((RESULTS, results_schema()), (COMMANDS, commands_schema())):
        assert file.read_text(encoding="utf-8") == text_of(schema), "python -m maintenance.schema"
        jsonschema.Draft202012Validator.check_schema(schema)


def test_the_results_of_every_stage_keep_to_the_schema(runs):
    found = [json.loads((run / "results.json").read_text()) for run in runs]
    assert {stage for one in found for stage in one["stages"]} == {*LIGHT_PATH} - {"diagnose"}
    assert [problem for one in found for problem in schema_problems(one)] == []


def test_every_array_of_every_product_has_the_axes_that_are_declared(runs):
    products = [read_product(path) for run in runs for path in sorted(run.glob("*.h5"))]
    for product in products:
        for name, array in product.arrays.items():
            declared = STAGES[product.stage].ARRAYS
            known = name_in(declared, name)
            assert known is not None, f"{product.stage}.{name}: say in ARRAYS of the stage what it is"
            axes = declared[known][1].split(",") if declared[known][1] else []
            assert len(axes) == array.value.ndim or "<array>" in known, known


def content(product: Product) -> tuple:
    """All of a product but when, where and how fast it was made."""
    arrays = {
        name: (one.value.tobytes(), None if one.error is None else one.error.tobytes())
        for name, one in product.arrays.items()
        if "seconds" not in name
    }
    return arrays, without_times(product.results), product.checks, product.config


def without_times(content):
    if isinstance(content, dict):
        return {key: without_times(value) for key, value in content.items() if "seconds" not in key}
    return [without_times(value) for value in content] if isinstance(content, list) else content


def test_a_second_run_with_eight_jobs_and_more_threads_of_numpy_gives_the_same_bits(runs):
    again = runs[0].with_name("again")
    with threadpool_limits(8, user_api="blas"):
        recipe, resources = load_recipe(runs[0].with_name("ramp.yaml")), Resources(jobs=8, report=False)
        run_recipe(recipe, again, resources=resources)
    names = sorted(path.name for path in runs[0].glob("*.h5"))
    assert len(names) == 6
    for name in names:
        assert content(read_product(again / name)) == content(read_product(runs[0] / name)), name


def test_a_process_with_another_seed_of_the_hashes_writes_the_same_bits(runs, tmp_path):
    """Sets and dictionaries of text come in another order where code relies on it."""
    command = [sys.executable, "-m", "irlos_pipe", "run", runs[0].with_name("ramp.yaml"), "--to", "ingest"]
    environment = os.environ | {"PYTHONHASHSEED": "1"}
    done = subprocess.run([*command, "--output", tmp_path], env=environment, capture_output=True, text=True)
    assert done.returncode in (0, 4), done.stderr
    assert (tmp_path / "recipe.resolved.yaml").read_bytes() == (runs[0] / "recipe.resolved.yaml").read_bytes()
    there, here = (
        json.loads((folder / "results.json").read_text())["stages"] for folder in (tmp_path, runs[0])
    )
    assert json.dumps(without_times(there["ingest"])) == json.dumps(without_times(here["ingest"]))
