"""What a run leaves for scripts: results.json, qc.json and the exit code."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import RunResults, provenance_of
from irlos_pipe.recipe import Recipe

EXIT_CODES = {
    "ok": ExitCode.DONE,
    "qc_failed": ExitCode.QUALITY,
    "partial": ExitCode.PARTIAL,
    "failed": ExitCode.UNEXPECTED,
}


@dataclass(frozen=True)
class Outcome:
    """The end of a run."""

    status: str  # ``ok``, ``qc_failed``, ``partial`` or ``failed``
    results: dict[str, Any]  # content of results.json
    quality: dict[str, Any]  # content of qc.json
    summary: dict[str, list[str]] = field(default_factory=dict)  # lines for people by stage
    report: Path | None = None
    report_error: str = ""  # why the report could not be built

    @property
    def exit_code(self) -> int:
        """Exit code of the command; a report that could not be built is an error of its own."""
        return EXIT_CODES[self.status] or int(bool(self.report_error))


def assess(recipe: Recipe, products: Mapping[str, Product], error: str = "") -> Outcome:
    """Sum up the up-to-date `products` of a run, which an `error` may have stopped."""
    status = "failed" if error else _status(products)
    results = RunResults(
        schema="irlos-results",
        schema_version=1,
        recipe=recipe.name,
        status=status,
        **({"notice": recipe.notice, "samples": list(recipe.samples)} if recipe.samples else {}),
        instrument=recipe.instrument.name,
        stages={name: product.results for name, product in products.items()},
        **({"error": error} if error else {}),
    )
    checks = [
        {"stage": name, **check.as_dict()} for name, product in products.items() for check in product.checks
    ]
    quality = {
        "schema": "irlos-qc",
        "schema_version": 1,
        "recipe": recipe.name,
        "passed": all(check["passed"] for check in checks),
        "checks": checks,
    }
    summary = {name: provenance_of(product).summary for name, product in products.items()}
    return Outcome(status, results.as_json(), quality, summary)


def _status(products: Mapping[str, Product]) -> str:
    # A failed limit outranks lost exposures: it says that the result may not be used.
    if any(not check.passed for product in products.values() for check in product.checks):
        return "qc_failed"
    if any(provenance_of(product).failures for product in products.values()):
        return "partial"
    return "ok"
