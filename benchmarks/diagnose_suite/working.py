"""One case from beginning to end: simulate, diagnose as a user does, keep what came out."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.diagnose_suite.cases import SINGLE, Case
from benchmarks.diagnose_suite.making import make_case
from benchmarks.diagnose_suite.planning import CALIBRATION, CUBE, RAMP
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.provenance import software_versions
from irlos_pipe.recipe import load_recipe

RECIPES = Path(__file__).parents[2] / "recipes"
NOT_KEPT = ("noise", "sentence", "model", "sigma_nm")
TRUTH_KEPT = ("kind", "suite_seed", "dirty", "setting", "level", "effects", "sizes", "known", "mild")
NOLLS = range(2, 31)  # of which the error is reported
BIASED_NM = 5.0  # from which an effect biases them


@dataclass(frozen=True)
class Folder:
    """Where everything of the suite lies."""

    path: Path

    def data(self, case: Case) -> Path:
        """Recordings: all that `diagnose` is given."""
        return self.path / "data" / case.name

    @property
    def truth(self) -> Path:
        """What is true, which `diagnose` never sees."""
        return self.path / "truth"

    def run(self, case: Case) -> Path:
        """Of the diagnosis."""
        return self.path / "runs" / case.name

    def reference(self, case: Case) -> Path:
        """Of a diagnosis with the true model."""
        return self.path / "true_models" / case.name

    def outcome(self, case: Case) -> Path:
        """What came out; there when the case is finished."""
        return self.path / "outcomes" / f"{case.name}.json"


def work(case: Case, folder: Folder) -> dict[str, Any]:
    """Outcome of a case, computed unless it is there."""
    if not folder.outcome(case).is_file():
        outcome = _worked(case, folder)
        folder.outcome(case).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(folder.outcome(case), json_text(outcome).encode())
    outcome = _present_keys(json.loads(folder.outcome(case).read_text()))
    if outcome["truth"]["suite_seed"] != case.suite_seed:
        raise ValueError(
            f"{folder.outcome(case)} has the seed {outcome['truth']['suite_seed']}, not {case.suite_seed}; "
            "give another folder"
        )
    return outcome


def _present_keys(outcome: dict[str, Any]) -> dict[str, Any]:
    """An outcome as it is written now; `told` is the former spelling of `diagnosis`."""
    renamed = {"diagnosis" if key == "told" else key: value for key, value in outcome.items()}
    formerly = {"suite_seed": 0, "dirty": False, "known": {}, "mild": {}}
    return renamed | {"truth": formerly | renamed["truth"]}


def _worked(case: Case, folder: Folder) -> dict[str, Any]:
    for leftover in (folder.data(case), folder.run(case), folder.reference(case)):
        shutil.rmtree(leftover, ignore_errors=True)
    began = time.process_time()
    make_case(case, folder.data(case), folder.truth)
    made = time.process_time()
    diagnosis = diagnosed(case, folder.data(case), folder.run(case), case.model_effects)
    ended = time.process_time()
    truth = json.loads((folder.truth / f"{case.name}.json").read_text())
    errors_nm = None if case.is_ramp else ncpa_errors_nm(diagnosis, truth)
    return {
        "case": case.name,
        "code": software_versions()["irlos_pipe"],
        "truth": {key: truth[key] for key in TRUTH_KEPT},
        "diagnosis": {key: value for key, value in diagnosis.items() if key not in NOT_KEPT},
        "ncpa_error_nm": errors_nm,
        "ncpa_bias_nm": _biases_nm(case, folder, diagnosis, truth)
        if _may_be_biased(case, errors_nm)
        else None,
        "cpu_s": {"simulate": made - began, "diagnose": ended - made},
    }


def diagnosed(case: Case, data: Path, output: Path, effects: Sequence[Any] | None) -> dict[str, Any]:
    """Run the recipe of the case on its recordings; returns what `results.json` says of `diagnose`.

    Parameters
    ----------
    effects : sequence or None
        That the model has already, unless it is the recipe's.
    """
    recipe = "diagnose_ramp" if case.is_ramp else case.setting.recipe
    inputs = [f"{name}={data / name}" for name in ((RAMP, CALIBRATION) if case.is_ramp else (CUBE,))]
    run_recipe(load_recipe(RECIPES / f"{recipe}.yaml", settings_of(effects), inputs), output)
    return json.loads((output / "results.json").read_text())["stages"]["diagnose"]


def settings_of(effects: Sequence[Any] | None) -> list[str]:
    """What is set beside the recipe."""
    if effects is None:
        return []
    return [f"model.effects={yaml.safe_dump(list(effects), default_flow_style=True, width=1000000).strip()}"]


def ncpa_errors_nm(diagnosis: dict[str, Any], truth: dict[str, Any]) -> dict[str, float]:
    """RMS error of Noll 2 to 30 with the model as it was, and with what was found."""
    true_nm = truth["mean_zernike_nm"][CUBE]
    return {
        when: float(np.linalg.norm([diagnosis["zernike_nm"][when][str(n)] - true_nm[str(n)] for n in NOLLS]))
        for when in ("before", "after")
    }


def _may_be_biased(case: Case, errors_nm: dict[str, float] | None) -> bool:
    """Whether it is worth while to fit the true model; of mild errors nobody has one."""
    return (
        case.kind == SINGLE and not case.dirty and errors_nm is not None and errors_nm["before"] > BIASED_NM
    )


def _biases_nm(
    case: Case, folder: Folder, diagnosis: dict[str, Any], truth: dict[str, Any]
) -> dict[str, float]:
    """RMS of what the model as it was, and that with what was found, add to the error of the true model.

    The same frames are fitted, so the noise and speckles that they share are none of it.
    """
    effects = case.true_model(with_noll_indices(truth["known"]))
    best = diagnosed(case, folder.data(case), folder.reference(case), effects)["zernike_nm"]["before"]
    return {
        when: float(np.linalg.norm([diagnosis["zernike_nm"][when][str(n)] - best[str(n)] for n in NOLLS]))
        for when in ("before", "after")
    }


def with_noll_indices(known: Any) -> Any:
    """Tables of modes with numbers for keys, which JSON makes text."""
    if not isinstance(known, dict):
        return known
    return {int(k) if k.isdecimal() else k: with_noll_indices(value) for k, value in known.items()}
