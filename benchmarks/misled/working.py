"""One case from beginning to end: make it, reduce it as a user does, compare with the truth."""

from __future__ import annotations

import json
import logging
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.misled.cases import CALIBRATION, DIAGNOSIS, RAMP, Case
from benchmarks.misled.making import Made, make_case
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
    made = make_case(case, scratch)
    outcome: dict[str, Any] = {
        "case": case.name,
        "kind": case.kind,
        "family": case.family,
        "setting": case.setting,
        "right": case.right,
        "suite_seed": case.suite_seed,
    }
    warned = Collected()
    try:
        products = reduced(_recipe(case, made), warned, scratch)
    except IrlosError as problem:
        return outcome | {"accused": [ERROR], "why": str(problem), "warned": warned.lines, "sigmas": None}
    failed = [check for product in products.values() for check in product.checks if not check.passed]
    return outcome | {
        "accused": [check.name for check in failed],
        "why": "; ".join(check.message for check in failed),
        "warned": warned.lines,
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
    """True errors over the quoted ones: of the worst mode, of a ramp as RMS; None of a diagnosis."""
    if case.kind == DIAGNOSIS:
        return {"sigmas": None, "verdict": products["diagnose"].results["verdict"]}
    if case.kind == RAMP:
        points = products["lift"].results["points"]
        error = np.array([point["defocus_nm"] or np.nan for point in points]) - made.introduced_nm
        sigma = np.array([point["sigma_nm"] or np.nan for point in points])
        return _both(error, sigma, float(np.sqrt(np.nanmean((error / sigma) ** 2))))
    results = products["calibrate"].results
    nolls = [noll for noll in results["zernike_nm"] if int(noll) > 3]
    error = np.array([results["zernike_nm"][noll] - made.ncpa_nm.get(int(noll), 0.0) for noll in nolls])
    sigma = np.array([results["sigma_nm"][noll] for noll in nolls])
    return _both(error, sigma, float(np.max(np.abs(error / sigma))))


def _both(error: np.ndarray, sigma: np.ndarray, sigmas: float) -> dict[str, Any]:
    return {
        "sigmas": sigmas,
        "error_nm": float(np.linalg.norm(error) if len(error) > 20 else np.sqrt(np.nanmean(error**2))),
        "quoted_nm": float(np.linalg.norm(sigma) if len(sigma) > 20 else np.sqrt(np.nanmean(sigma**2))),
    }
