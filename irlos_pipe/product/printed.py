"""What commands print with ``--json``: models whose fields are the keys; the schema is made from them."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import Field

from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.product.results import Number, Provenance, ResultsPart


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
    value: Number = math.nan
    unit: str = ""
    low: Number = math.nan
    high: Number = math.nan
    message: str = ""


class ProductRow(ResultsPart):
    """Where a product of a run stands.

    Attributes
    ----------
    product : str
        File name.
    state : str
        ``up to date``, ``outdated``, ``not of this recipe`` or ``cannot be checked``.
    reason : str
        Why it is not up to date; empty if it is.
    checks, passed : int or None
        Checks of quality, and how many of them passed; None without a product that can be read.
    finished : str
        UTC, ISO 8601.
    """

    product: str = ""
    state: str = ""
    reason: str = ""
    checks: int | None = None
    passed: int | None = None
    finished: str = ""


class RunStatus(Printed):
    """What ``irlos status DIR --json`` prints of a run.

    Attributes
    ----------
    run : str
        The folder.
    current : bool
        Whether all products of the recipe are up to date.
    """

    format: Literal["irlos-status"] = Field("irlos-status", alias="schema")
    run: str = ""
    current: bool = False
    products: list[ProductRow] = []


class VersionRow(ResultsPart):
    """A numbered version of a reduction.

    Attributes
    ----------
    version : str
        Its folder, ``001``.
    status : str
        That of its results.json; ``incomplete`` where products are missing.
    latest : bool
        Whether it is the newest complete one, to which ``latest`` links.
    finished : str
        When its last product was made: UTC, ISO 8601.
    software : str
        Version and revision of irlos_pipe.
    changed : list of str
        Settings that differ from those of the version before.
    """

    version: str = ""
    recipe: str = ""
    status: str = ""
    latest: bool = False
    finished: str = ""
    software: str = ""
    changed: list[str] = []


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
    """What ``irlos show PRODUCT.h5 --json`` prints: everything but the values of the arrays.

    Attributes
    ----------
    product : str
        File name.
    results : dict
        The stage's section of results.json.
    """

    format: Literal["irlos-show"] = Field("irlos-show", alias="schema")
    product: str = ""
    stage: str = ""
    provenance: Provenance = Provenance()
    arrays: list[ArrayRow] = []
    results: dict[str, Any] = {}
    configuration: dict[str, Any] = {}
    checks: list[CheckRow] = []
    log: list[str] = []


class HeldProduct(ResultsPart):
    """A product in the folder of a run.

    Attributes
    ----------
    arrays, checks, passed : int or None
        How many arrays and checks of quality it has, and how many of these passed; None where it cannot be
        read, as `problem` says.
    summary : list of str
        What the stage said on the terminal.
    """

    product: str = ""
    stage: str = ""
    arrays: int | None = None
    checks: int | None = None
    passed: int | None = None
    summary: list[str] = []
    problem: str = ""


class ShownRun(Printed):
    """What ``irlos show DIR --json`` prints.

    Attributes
    ----------
    run : str
        The folder.
    recipe, status, notice : str
        As in results.json; empty without one.
    files : list of str
        What the folder holds besides the products.
    """

    format: Literal["irlos-show-run"] = Field("irlos-show-run", alias="schema")
    run: str = ""
    recipe: str = ""
    status: str = ""
    notice: str = ""
    products: list[HeldProduct] = []
    files: list[str] = []


class Validation(Printed):
    """What ``irlos validate RECIPE --json`` prints.

    Attributes
    ----------
    recipe : str
        As it was given; `name` is what the recipe calls itself.
    inputs : dict of str to list of str
        Paths that were given by input; an empty list for one that is still to be given.
    problems : list of str
        What is wrong, a line each, as on the terminal.
    """

    format: Literal["irlos-validate"] = Field("irlos-validate", alias="schema")
    recipe: str = ""
    valid: bool = False
    name: str = ""
    stages: list[str] = []
    inputs: dict[str, list[str]] = {}
    problems: list[str] = []
