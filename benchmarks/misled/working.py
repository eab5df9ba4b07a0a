"""One case from beginning to end: make it, reduce it as a user does, compare with the truth."""

from __future__ import annotations

import json
import logging
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.misled.cases import CALIBRATION, DIAGNOSIS, NIGHT, RAMP, Case
from benchmarks.misled.judging import diagnosis_errors, mode_errors, ramp_errors
from benchmarks.misled.making import Made, make_case
from benchmarks.misled.nights import night_outcome
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.pipeline.resources import silent_progress
from irlos_pipe.product.product import Product
from irlos_pipe.recipe import Recipe, load_recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import StageContext

RECIPES = {CALIBRATION: "ncpa_calibration", RAMP: "defocus_ramp", DIAGNOSIS: "diagnose"}
# Noll 66 ends the modes: the open basis costs five times as long and has the same low modes.
SETTINGS = {
    CALIBRATION: ("calibrate.highest_noll=66",),
    RAMP: ("calibrate.highest_noll=66",),
    DIAGNOSIS: (),
}
LAST = {CALIBRATION: "calibrate", RAMP: "lift", DIAGNOSIS: "diagnose"}
WRONG_SIGMA = 5.0
ERROR = "refused"


class Collected(logging.Handler):
    """Keeps warnings as text."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())


def work(case: Case, folder: Path) -> dict[str, Any]:
    """Outcome of a case, computed unless it lies in the `folder`."""
    path = folder / f"{case.name}.json"
    if not path.is_file():
        with tempfile.TemporaryDirectory() as scratch:
            began = time.process_time()
            outcome = _worked(case, Path(scratch)) | {"cpu_s": round(time.process_time() - began, 2)}
        write_bytes(path, json_text(outcome).encode())
    outcome = json.loads(path.read_text())
    if outcome["suite_seed"] != case.suite_seed:
        raise ValueError(f"{path} has the seed {outcome['suite_seed']}; give another folder")
    return outcome


def _worked(case: Case, scratch: Path) -> dict[str, Any]:
    outcome: dict[str, Any] = {
        "case": case.name,
        "kind": case.kind,
        "family": case.family,
        "setting": case.setting,
        "right": case.right,
        "cause": case.cause,
        "suite_seed": case.suite_seed,
    }
    warned = Collected()
    try:
        if case.kind == NIGHT:
            return outcome | night_outcome(case, scratch)
        made = make_case(case, scratch)
        products = reduced(_recipe(case, made), warned, scratch)
    except IrlosError as problem:
        return outcome | {"accused": [ERROR], "why": str(problem), "warned": warned.lines, "sigmas": None}
    failed = [check for product in products.values() for check in product.checks if not check.passed]
    return outcome | {
        "accused": [check.name for check in failed],
        "why": "; ".join(check.message for check in failed),
        "warned": warned.lines,
        "untested": products[LAST[case.kind]].results.get("untested", []),
        **_errors(case, made, products),
    }


def _recipe(case: Case, made: Made) -> Recipe:
    declared = {CALIBRATION: ("calibration",), RAMP: ("ramp", "calibration"), DIAGNOSIS: ("cube",)}[case.kind]
    inputs = [f"{name}={path}" for name in declared for path in made.inputs[name]]
    return load_recipe(RECIPES[case.kind], SETTINGS[case.kind], inputs)


def reduced(recipe: Recipe, warned: logging.Handler, scratch: Path) -> dict[str, Product]:
    """Run the stages of a `recipe` one after the other, without files and report."""
    log = logging.Logger("misled")
    log.addHandler(warned)
    products: dict[str, Product] = {}
    for name in recipe.stages:
        if name == "correct":
            continue
        stage, config = STAGES[name], recipe.configs[name]
        ctx: StageContext[Any] = StageContext(
            config,
            recipe.model,
            recipe.instrument,
            recipe.inputs,
            products,
            "cpu",
            recipe.seed,
            1,
            silent_progress,
            log,
            scratch / name,
        )
        output = stage.run(ctx)
        settings = config.model_dump(mode="json")
        results = output.results.as_json()
        products[name] = Product(name, output.arrays, results, list(output.checks), settings)
    return products


def _errors(case: Case, made: Made, products: dict[str, Product]) -> dict[str, Any]:
    """True errors over the quoted ones, and of a diagnosis what it found."""
    results = products[LAST[case.kind]].results
    if case.kind == DIAGNOSIS:
        return diagnosis_errors(case, results, made.ncpa_nm)
    if case.kind == RAMP:
        return ramp_errors(results, made.introduced_nm)
    return mode_errors(results["zernike_nm"], results["sigma_nm"], made.ncpa_nm)
