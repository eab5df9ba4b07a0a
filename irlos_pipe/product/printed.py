"""What commands print with ``--json``: models whose fields are the keys; the schema is made from them."""

from __future__ import annotations

from math import nan
from typing import Any, Literal

from pydantic import Field

from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.product.results import DITTO, Number, Provenance, ResultsPart, item


class Printed(ResultsPart):
    """Base of what a command prints with ``--json``."""

    schema_version: int = 1

    def as_json(self) -> dict[str, Any]:
        """Return all keys in the types of JSON."""
        return jsonable(self.model_dump(by_alias=True))

    def text(self) -> str:
        """Return the JSON as it is printed."""
        return json_text(self.as_json()).rstrip()


class CheckRow(ResultsPart):
    """A check of quality as it stands in qc.json."""

    name: str = ""
    passed: bool = False
    value: Number = nan
    unit: str = ""
    low: Number = nan
    high: Number = nan
    message: str = ""


class ProductRow(ResultsPart):
    """Where a product of a run stands."""

    product: str = item("", "File name.")
    state: str = item("", "``up to date``, ``outdated``, ``not of this recipe`` or ``cannot be checked``.")
    reason: str = item("", "Why it is not up to date; empty if it is.")
    checks: int | None = item(
        None, "Checks of quality, and how many of them passed; None without a product that can be read."
    )
    passed: int | None = item(None, DITTO)
    finished: str = item("", "UTC, ISO 8601.")


class RunStatus(Printed):
    """What ``irlos status DIR --json`` prints of a run."""

    format: Literal["irlos-status"] = Field("irlos-status", alias="schema")
    run: str = item("", "The folder.")
    current: bool = item(False, "Whether all products of the recipe are up to date.")
    products: list[ProductRow] = []


class VersionRow(ResultsPart):
    """A numbered version of a reduction."""

    version: str = item("", "Its folder, ``001``.")
    recipe: str = ""
    status: str = item("", "That of its results.json; ``incomplete`` where products are missing.")
    latest: bool = item(False, "Whether it is the newest complete one, to which ``latest`` links.")
    finished: str = item("", "When its last product was made: UTC, ISO 8601.")
    software: str = item("", "Version and revision of irlos_pipe.")
    changed: list[str] = item([], "Settings that differ from those of the version before.")


class Versions(Printed):
    """What ``irlos status DIR --json`` prints of a folder of numbered versions."""

    format: Literal["irlos-versions"] = Field("irlos-versions", alias="schema")
    folder: str = ""
    versions: list[VersionRow] = []


class ArrayRow(ResultsPart):
    """An array of a product."""

    name: str = ""
    shape: list[int] = []
    type: str = ""
    unit: str = ""
    with_error: bool = False
    description: str = ""


class ShownProduct(Printed):
    """What ``irlos show PRODUCT.h5 --json`` prints: everything but the values of the arrays."""

    format: Literal["irlos-show"] = Field("irlos-show", alias="schema")
    product: str = item("", "File name.")
    stage: str = ""
    provenance: Provenance = Provenance()
    arrays: list[ArrayRow] = []
    results: dict[str, Any] = item({}, "The stage's section of results.json.")
    configuration: dict[str, Any] = {}
    checks: list[CheckRow] = []
    log: list[str] = []


class HeldProduct(ResultsPart):
    """A product in the folder of a run."""

    product: str = ""
    stage: str = ""
    arrays: int | None = item(
        None,
        "How many arrays and checks of quality it has, and how many of these passed; None where it cannot "
        "be read, as `problem` says.",
    )
    checks: int | None = item(None, DITTO)
    passed: int | None = item(None, DITTO)
    summary: list[str] = item([], "What the stage said on the terminal.")
    problem: str = ""


class ShownRun(Printed):
    """What ``irlos show DIR --json`` prints."""

    format: Literal["irlos-show-run"] = Field("irlos-show-run", alias="schema")
    run: str = item("", "The folder.")
    recipe: str = item("", "As in results.json; empty without one.")
    status: str = item("", DITTO)
    notice: str = item("", DITTO)
    products: list[HeldProduct] = []
    files: list[str] = item([], "What the folder holds besides the products.")


class Validation(Printed):
    """What ``irlos validate RECIPE --json`` prints."""

    format: Literal["irlos-validate"] = Field("irlos-validate", alias="schema")
    recipe: str = item("", "As it was given; `name` is what the recipe calls itself.")
    valid: bool = False
    name: str = ""
    stages: list[str] = []
    inputs: dict[str, list[str]] = item(
        {}, "Paths that were given by input; an empty list for one that is still to be given."
    )
    problems: list[str] = item([], "What is wrong, a line each, as on the terminal.")
