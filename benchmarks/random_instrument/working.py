"""One case from beginning to end: simulate, reduce as a user does, keep outcome and truth."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.diagnose_suite.making import record
from benchmarks.random_instrument.cases import Case
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.provenance import software_versions
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.effects.wavefront import DiversityError, WavefrontEffect
from irlos_pipe.simulate.exposure import static_zernike_nm
from irlos_pipe.simulate.scene import Scene

HIGHEST_TRUE_NOLL = 200  # fitted to true wavefronts: with fewer modes what lies beyond falls on the last ones


def work(case: Case, folder: Path) -> dict[str, Any]:
    """Return the outcome of a `case`, computed unless it lies in the `folder`."""
    path = folder / f"{case.name}.json"
    if not path.is_file():
        with tempfile.TemporaryDirectory() as scratch:
            outcome = outcome_of(case, Path(scratch))
        write_bytes(path, json_text(outcome).encode())
    outcome = json.loads(path.read_text())
    if (outcome["seed"], outcome["frames"]) != (case.seed, case.frames):
        raise ValueError(f"{path} has another seed or number of frames; give another folder")
    return outcome


def outcome_of(case: Case, scratch: Path) -> dict[str, Any]:
    """Simulate and calibrate a `case` in the folder `scratch`; return what came out, in JSON types."""
    began = time.process_time()
    planned = case.planned(scratch / "spec.yaml")
    mean_nm = record(planned, scratch / "cube", HIGHEST_TRUE_NOLL)
    made = time.process_time()
    truth = {
        "mean_nm": mean_nm,
        "static_nm": static_zernike_nm(planned.scene),
        "diversity_error_nm": _diversity_error_nm(planned.scene),
    }
    return {
        "code": software_versions()["irlos_pipe"],
        "seed": case.seed,
        "index": case.index,
        "frames": case.frames,
        "seeing_arcsec": case.seeing_arcsec,
        "without": case.without,
        "hidden": planned.scene.effects,
        "shape": planned.scene.sky.shape,
        "truth": truth,
        "simulate_s": made - began,
        "plain": _calibrated(scratch, "plain"),
        "diagnosed": _diagnosed(scratch) if case.diagnosed else None,
    }


def _diversity_error_nm(scene: Scene) -> dict[int, float]:
    """What the diversity has beyond that as told, Noll: nm RMS; part of the wavefronts of the truth."""
    errors = [effect for effect in scene.acting(WavefrontEffect) if isinstance(effect, DiversityError)]
    return dict(errors[0].static_zernike_nm(scene.diversity_nm)) if errors else {}


def _calibrated(scratch: Path, name: str, *settings: str) -> dict[str, Any]:
    """Run the default calibration."""
    began = time.process_time()
    recipe = load_recipe("ncpa_calibration", settings, [f"calibration={scratch / 'cube'}"])
    outcome = run_recipe(recipe, scratch / name)
    stage = outcome.results["stages"]["calibrate"]
    return {
        "exit_code": outcome.exit_code,
        "failed": [check["name"] for check in outcome.quality["checks"] if not check["passed"]],
        "zernike_nm": stage["zernike_nm"],
        "sigma_nm": stage["sigma_nm"],
        "chi2_nu": stage["chi2_nu"],
        "cpu_s": time.process_time() - began,
    }


def _diagnosed(scratch: Path) -> dict[str, Any]:
    """Diagnose, then calibrate with the model that the diagnosis leaves."""
    began = time.process_time()
    outcome = run_recipe(load_recipe("diagnose", [], [f"cube={scratch / 'cube'}"]), scratch / "diagnosis")
    found = outcome.results["stages"]["diagnose"]
    model = scratch / "diagnosis" / "model.yaml"
    return _calibrated(scratch, "named", f"model={model}") | {
        "diagnosis_exit_code": outcome.exit_code,
        "verdict": found["verdict"],
        "grade": found["grade"],
        "names": [step["effect"] for step in found["steps"]],
        "model": model.read_text(),
        "cpu_s": time.process_time() - began,
    }
