"""What a product contains, without the values of its arrays."""

from __future__ import annotations

from pathlib import Path

from irlos_pipe.product.printed import ArrayRow, CheckRow, ShownProduct
from irlos_pipe.product.quantity import Quantity
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.storage import read_product


def shown_product(path: Path) -> ShownProduct:
    """Return what the product at `path` contains.

    Raises
    ------
    InputDataError
        When it cannot be read.
    """
    product = read_product(path)
    return ShownProduct(
        product=path.name,
        stage=product.stage,
        provenance=provenance_of(product),
        arrays=[_array(name, quantity) for name, quantity in product.arrays.items()],
        results=product.results,
        configuration=product.config,
        checks=[CheckRow(**check.as_dict()) for check in product.checks],
        log=product.log,
    )


def _array(name: str, quantity: Quantity) -> ArrayRow:
    return ArrayRow(
        name=name,
        shape=list(quantity.value.shape),
        type=str(quantity.value.dtype),
        unit=quantity.unit,
        with_error=quantity.error is not None,
        description=quantity.description,
    )
