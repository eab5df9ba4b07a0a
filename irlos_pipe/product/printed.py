"""What commands print with ``--json``: models whose fields are the keys; the schema is made from them."""

from math import nan
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.product.results import (
    DITTO,
    Number,
    Provenance,
    ResultsPart,
    RunResults,
    item,
    provenance_of,
    read_run_results,
)
from irlos_pipe.product.runfolder import existing_run


class Printed(ResultsPart):
    """Base of what a command prints with ``--json``."""

    schema_version: int = 1

    def as_json(self) -> dict[str, Any]:
        """Return all keys in the types of JSON."""
        return jsonable(self.model_dump(by_alias=True))

    def text(self) -> str:
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


class ShownRecordings(Printed):
    """What ``irlos show FITS --json`` prints."""

    format: Literal["irlos-show-recordings"] = Field("irlos-show-recordings", alias="schema")
    recordings: list[dict[str, str]] = item([], "What each is, and what to do with it, as on the terminal.")


class PlannedStage(ResultsPart):
    """A stage in the list that ``irlos run … --dry-run --json`` prints."""

    stage: str = ""
    action: str = item("", "``run``, ``skip``, ``use as it is`` or ``not selected``.")
    reason: str = item("", "Why it is run, or not.")


class TrendPoint(ResultsPart):
    """A number of a run, and the band in which it was expected; null without one."""

    run: str = ""
    night: str = ""
    unix_s: Number = nan
    value: Number = nan
    sigma: float | None = None
    band: list[float] | None = None


class TrendSeries(ResultsPart):
    """A number over the nights."""

    name: str = ""
    recipe: str = ""
    configuration: str = ""
    limits: list[float | None] | None = item(None, "Limits of quality; null without any.")
    points: list[TrendPoint] = []


class ShownTrend(Printed):
    """What ``irlos trend TREE --json`` prints."""

    format: Literal["irlos-trend"] = Field("irlos-trend", alias="schema")
    series: list[TrendSeries] = []
    wavefronts: list[dict[str, Any]] = item([], "Test of the whole wavefront of each run.")
    stability: list[dict[str, Any]] = item([], "How the wavefront changes with time, by recipe.")
    verdicts: list[dict[str, Any]] = item([], "Of the diagnoses.")
    alarms: list[str] = item([], "Of the last night.")


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


class NumberPair(ResultsPart):
    """A number of results.json in two runs."""

    stage: str = ""
    name: str = item("", "Path in the section of the stage; rows of a list by what they are called.")
    unit: str = ""
    first: Number = nan
    second: Number = nan
    first_error: Number = item(nan, "Standard errors; null for a number without one.")
    second_error: Number = item(nan, DITTO)
    difference: Number = item(nan, "The second less the first.")
    sigmas: Number = item(nan, "The difference in units of both errors in quadrature; null without both.")


class ModesPair(ResultsPart):
    """All coefficients of a wavefront in two runs."""

    stage: str = ""
    name: str = ""
    modes: int = item(0, "How many both runs have.")
    difference_nm: Number = item(nan, "RMS of the wavefront between them, and what both errors add up to.")
    expected_nm: Number = item(nan, DITTO)


class ValuePair(ResultsPart):
    """Anything else that differs; null for what only the other run has."""

    name: str = ""
    first: Any = None
    second: Any = None


class Comparison(Printed):
    """What ``irlos compare FIRST SECOND --json`` prints."""

    format: Literal["irlos-compare"] = Field("irlos-compare", alias="schema")
    first: str = item("", "Folders of the runs.")
    second: str = item("", DITTO)
    same_files: bool = item(
        False, "Whether both reduce the same files, so that their errors are not independent."
    )
    told: list[ValuePair] = item([], "Recipe, status, and versions of the software that differ.")
    settings: list[ValuePair] = item([], "Keys of the recipe, and input files (checksums), that differ.")
    files: list[ValuePair] = item([], DITTO)
    modes: list[ModesPair] = item([], "Wavefronts as a whole.")
    numbers: list[NumberPair] = item([], "Every number that both runs have, also where it is the same.")
    words: list[ValuePair] = item([], "Verdicts, methods and other words of results.json that differ.")
    only_first: list[str] = item([], "What only one of them has.")
    only_second: list[str] = item([], DITTO)
    checks: list[ValuePair] = item([], "Checks that passed in one of them and failed in the other.")


class MethodScore(ResultsPart):
    """Errors of a calibration against the truth."""

    method: str = ""
    error_nm: Number = item(nan, "RMS error of the reported modes against the mean wavefront.")
    defocus_error_nm: Number = item(nan, "Error of its defocus, with sign.")
    seconds: Number = item(nan, "Time of the fit.")
    static_error_nm: Number = item(
        nan,
        "RMS error against the static modes without tip and tilt, and the RMS of these errors in units of "
        "the quoted ones; null where the truth does not state static modes.",
    )
    pull_rms: Number = item(nan, DITTO)


class CalibrationScore(ResultsPart):
    """How far a calibration is from the truth, by method."""

    recordings: list[str] = []
    static_known: bool = False
    methods: list[MethodScore] = []


class RampScore(ResultsPart):
    """RMS errors of the defocus of a ramp."""

    recordings: int = item(0, "How many are compared.")
    frames: int = item(0, DITTO)
    against_introduced_nm: Number = item(
        nan, "Frames against the introduced defocus, and against the true mean defocus."
    )
    against_true_nm: Number = item(nan, DITTO)
    means_against_true_nm: Number = item(nan, "Means of recordings against the true mean defocus.")


class Score(Printed):
    """What ``irlos score DIR --json`` prints; None for what was not run or has no truth."""

    format: Literal["irlos-score"] = Field("irlos-score", alias="schema")
    run: str = ""
    calibration: CalibrationScore | None = None
    ramp: RampScore | None = None


# -- what a product contains, without the values of its arrays, and which products a run has ---------


def shown_product(path: Path) -> ShownProduct:
    """Return what the product at `path` contains; `InputDataError` when it cannot be read."""
    from irlos_pipe.product.storage import read_product

    product = read_product(path)
    return ShownProduct.filled_from(
        product,
        product=path.name,
        provenance=provenance_of(product),
        arrays=[
            ArrayRow.filled_from(
                one,
                name=name,
                shape=list(one.value.shape),
                type=str(one.value.dtype),
                with_error=one.error is not None,
            )
            for name, one in product.arrays.items()
        ],
        configuration=product.config,
        checks=[CheckRow.filled_from(check) for check in product.checks],
    )


def shown_run(folder: Path) -> ShownRun:
    """Return which products the run in `folder` has, and what their stages said.

    Raises `InputDataError` when `folder` holds no run, or its results.json cannot be read.
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
    from irlos_pipe.product.storage import open_product

    try:
        product = open_product(path)
        passed = sum(check.passed for check in product.checks)
        counts = {"arrays": len(product.arrays), "checks": len(product.checks), "passed": passed}
        return HeldProduct.filled_from(product, product=path.name, **counts)
    except InputDataError as error:
        return HeldProduct(product=path.name, problem=str(error))
