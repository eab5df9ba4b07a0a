"""The same input and seed give the same results to the bit: with one job or eight, and a second time.

Truth: the same recipe run with one job. Numbers of modes, frames and draws are small, the code is that of
a full reduction.
"""

from pathlib import Path

import pytest
from helpers import sparta_files
from threadpoolctl import threadpool_limits

from irlos_pipe.pipeline import Resources, run_recipe
from irlos_pipe.product.product import Product
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import load_recipe

pytestmark = pytest.mark.slow

RECIPE = """\
recipe: small
inputs: {calibration: data/cube, ramp: data/ramp}
stages: [ingest, prior, calibrate, lift, sensitivity, correct]
seed: 5
model: {pupil_samples: 48}
calibrate: {method: lift_slices, highest_noll: 6, max_iterations: 3}
lift: {start: zero, compare: false, max_iterations: 3}
sensitivity: {faintest_mag_j: 9.5, realisations: 2, modes: [[2, 3, 4]], calibrated: [true]}
"""
OFFSETS_NM = (-60.0, 0.0, 60.0)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bits")
    sparta_files.write_recorder(folder / "data" / "cube", sparta_files.counts(sparta_files.star(16, 16), 6))
    for number, offset in enumerate(OFFSETS_NM):
        adu = sparta_files.counts(sparta_files.star(16, 16), frames=1, seed=number)
        keys = {"role": "defocus_ramp", "introduced_defocus_nm": offset}
        sparta_files.write_recorder(folder / "data" / "ramp" / f"offset_{number}", adu, keys=keys)
    (folder / "small.yaml").write_text(RECIPE)
    return folder / "small.yaml"


@pytest.fixture(scope="module")
def with_one_job(recipe) -> dict[str, Product]:
    return products(recipe, "one", 1)


def products(recipe: Path, name: str, jobs: int, seed: int | None = None) -> dict[str, Product]:
    folder = recipe.parent / name
    run_recipe(load_recipe(recipe, seed=seed), folder, resources=Resources(jobs=jobs))
    return {path.stem: read_product(path) for path in sorted(folder.glob("*.h5"))}


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


@pytest.mark.parametrize(("jobs", "blas_threads"), [(8, 8), (1, 1)])
def test_eight_jobs_more_threads_of_numpy_and_a_second_run_give_the_same_bits(
    recipe, with_one_job, jobs, blas_threads
):
    with threadpool_limits(blas_threads, user_api="blas"):
        again = products(recipe, f"again-{jobs}", jobs)
    assert list(again) == list(with_one_job) and len(again) == 6
    for name, product in again.items():
        assert content(product) == content(with_one_job[name]), name
