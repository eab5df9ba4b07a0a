"""One case from beginning to end: simulate, diagnose as a user does, keep what came out."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml

from benchmarks import harness
from benchmarks.diagnose_suite.cases import CLEAN, RAMP_CLEAN, SINGLE, Case, all_cases, in_one_setting
from benchmarks.diagnose_suite.making import CALIBRATION, CUBE, RAMP, make_case
from benchmarks.diagnose_suite.scoring import BIASED_NM, write_report
from benchmarks.harness import REPOSITORY, Outcome, Suite
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.run import software_versions
from irlos_pipe.recipe import load_recipe

REPORTED_SEED = 86602540  # of the reported runs; no threshold may rest on its cases
RECIPES = REPOSITORY / "recipes"
NOT_KEPT = ("noise", "sentence", "model", "sigma_nm")
TRUTH_KEPT = ("kind", "suite_seed", "dirty", "setting", "level", "effects", "sizes", "known", "mild")
# Of outcomes that are kept with the project: what scores need.
SLIM_DIAGNOSIS = ("verdict", "grade", "gap", "chi2_nu", "seconds", "untestable", "why_unknown")
SLIM_STEP = ("effect", "indistinguishable", "parameters", "sigma", "significance")
NOLLS = range(2, 31)  # modes of which the error is reported


def outcome_of(case: Case, output: Path) -> Outcome:
    """Simulate a case into the folder `output`, diagnose it, and compare with the truth.

    ``data`` there is all that `diagnose` is given, ``truth`` what it never sees; ``runs`` has the diagnoses,
    ``true_models`` those with the true model.
    """
    data, run, reference = (output / part / case.name for part in ("data", "runs", "true_models"))
    for leftover in (data, run, reference):
        shutil.rmtree(leftover, ignore_errors=True)
    began = time.process_time()
    truth = make_case(case, data, output / "truth")
    made = time.process_time()
    diagnosis = diagnosed(case, data, run, case.model_effects)
    ended = time.process_time()
    errors_nm = None if case.is_ramp else _rms_nm(diagnosis, truth["mean_zernike_nm"][CUBE])
    biases_nm = None
    # It is worth while to fit the true model; of mild errors there is none.
    if case.kind == SINGLE and not case.dirty and errors_nm["before"] > BIASED_NM:
        # The same frames are fitted, so the noise and speckles that they share are no part of the bias.
        true_model = diagnosed(case, data, reference, case.true_model(truth["known"]))
        best_nm = true_model["zernike_nm"]["before"]
        biases_nm = _rms_nm(diagnosis, {noll: best_nm[str(noll)] for noll in NOLLS})
    return {
        "case": case.name,
        "code": software_versions()["irlos_pipe"],
        "truth": {key: truth[key] for key in TRUTH_KEPT},
        "diagnosis": {key: value for key, value in diagnosis.items() if key not in NOT_KEPT},
        "ncpa_error_nm": errors_nm,
        "ncpa_bias_nm": biases_nm,
        "cpu_s": {"simulate": made - began, "diagnose": ended - made},
    }


def diagnosed(case: Case, data: Path, output: Path, effects: Sequence[Any] | None) -> dict[str, Any]:
    """Run the recipe of the case, its model with other `effects` if there are any; what `diagnose` says."""
    recipe = "diagnose_ramp" if case.is_ramp else case.setting.recipe
    inputs = [f"{name}={data / name}" for name in ((RAMP, CALIBRATION) if case.is_ramp else (CUBE,))]
    run_recipe(load_recipe(RECIPES / f"{recipe}.yaml", settings_of(effects), inputs), output)
    return json.loads((output / "results.json").read_text())["stages"]["diagnose"]


def settings_of(effects: Sequence[Any] | None) -> list[str]:
    """Settings on top of the recipe."""
    if effects is None:
        return []
    return [f"model.effects={yaml.safe_dump(list(effects), default_flow_style=True, width=1000000).strip()}"]


def _rms_nm(diagnosis: dict[str, Any], true_nm: dict[int, float]) -> dict[str, float]:
    """RMS error of Noll 2 to 30 with the model as it was, and with what was found."""
    found_nm = diagnosis["zernike_nm"]
    return {
        when: float(np.linalg.norm([found_nm[when][str(noll)] - true_nm[noll] for noll in NOLLS]))
        for when in ("before", "after")
    }


# -- the suite ---------------------------------------------------------------------------------


def key_of(outcome: Outcome) -> tuple:
    """Return what an outcome says of its case."""
    return outcome["truth"]["suite_seed"], outcome["case"]


def slim(outcome: Outcome) -> Outcome:
    """Return an outcome without what no score needs."""
    diagnosis, clean = outcome["diagnosis"], outcome["truth"]["kind"] in (CLEAN, RAMP_CLEAN)
    slim = {key: diagnosis[key] for key in SLIM_DIAGNOSIS if key in diagnosis}
    slim["steps"] = [{key: step[key] for key in SLIM_STEP if key in step} for step in diagnosis["steps"]]
    slim["nearest"] = {"effect": (diagnosis.get("nearest") or {}).get("effect")}
    slim["mdb"] = diagnosis["mdb"] if clean else {}  # those of clean recordings are the smallest sizes
    return {**outcome, "diagnosis": slim}


def present(outcome: Outcome) -> Outcome:
    """Return an outcome as it is written now; `told` is the former spelling of `diagnosis`."""
    renamed = {"diagnosis" if key == "told" else key: value for key, value in outcome.items()}
    formerly = {"suite_seed": 0, "dirty": False, "known": {}, "mild": {}}
    return renamed | {"truth": formerly | renamed["truth"]}


SUITE = Suite(outcome_of, key_of, write_report, inside="outcomes", slim=slim, present=present)


@click.command()
@harness.options(REPORTED_SEED)
@click.option("--dirty", is_flag=True, help="Beside what is hidden, everything has a mild error.")
@click.option("--once", is_flag=True, help="Each in one of its settings, which take turns.")
@click.option("--shuffled", is_flag=True, help="In random order: wherever it is stopped, a fair sample.")
def main(dirty: bool, once: bool, shuffled: bool, seed: int, only: str, sample: int | None, **how) -> None:
    """Hide effects in simulated recordings and see whether `diagnose` names them.

    A folder is gone on with where it stopped: finished cases are kept.
    """
    every = all_cases(seed, dirty)
    cases = harness.chosen(in_one_setting(every) if once else every, only, sample)
    if shuffled:
        cases = list(np.random.default_rng(seed).permutation(np.array(cases, dtype=object)))
    harness.run(SUITE, cases, **how)
