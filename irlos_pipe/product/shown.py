"""What a product contains, without the values of its arrays, and which products a run has."""

from __future__ import annotations

from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.printed import ArrayRow, CheckRow, HeldProduct, ShownProduct, ShownRun
from irlos_pipe.product.product import Quantity
from irlos_pipe.product.results import RunResults, provenance_of, read_run_results
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import open_product, read_product


def shown_product(path: Path) -> ShownProduct:
    """Return what the product at `path` contains.

    Raises
    ------
    InputDataError
        When it cannot be read.
    """
    product = read_product(path)
    return ShownProduct.filled_from(
        product,
        product=path.name,
        provenance=provenance_of(product),
        arrays=[_array(name, quantity) for name, quantity in product.arrays.items()],
        configuration=product.config,
        checks=[CheckRow.filled_from(check) for check in product.checks],
    )


def shown_run(folder: Path) -> ShownRun:
    """Return which products the run in `folder` has, and what their stages said.

    Raises
    ------
    InputDataError
        When `folder` holds no run, or its results.json cannot be read.
    """
    run = existing_run(folder)
    results = read_run_results(run.results) if run.results.is_file() else RunResults()
    products = run.product_files
    others = {path.name for path in run.path.iterdir() if path.is_file() and not path.name.startswith(".")}
    return ShownRun(
        run=str(folder),
        recipe=results.recipe,
        status=results.status,
        notice=results.notice,
        products=[_held(path) for path in products],
        files=sorted(others - {path.name for path in products}),
    )


def _held(path: Path) -> HeldProduct:
    try:
        product = open_product(path)
        passed = sum(check.passed for check in product.checks)
        counts = {"arrays": len(product.arrays), "checks": len(product.checks), "passed": passed}
        return HeldProduct.filled_from(product, product=path.name, **counts)
    except InputDataError as error:
        return HeldProduct(product=path.name, problem=str(error))


def _array(name: str, quantity: Quantity) -> ArrayRow:
    return ArrayRow.filled_from(
        quantity,
        name=name,
        shape=list(quantity.value.shape),
        type=str(quantity.value.dtype),
        with_error=quantity.error is not None,
    )
