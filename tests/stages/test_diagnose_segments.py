"""A mirror whose segments are out of step, from raw files to the verdict.

Truth: the simulator's images of the pupil of Keck, which shares no optics with the model, with pistons drawn
here, photon and detector noise, and no sky.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.simulation_specs import simulated

from irlos_pipe.commands.main import cli

PISTON_NM = 20.0 * np.random.default_rng(11).standard_normal(36)
CUBE = {
    "role": "ncpa_calibration",
    "mag_j": 8.0,
    "frames": 40,
    "exposure_s": 0.1,
    "bands": "narrow_h",
    "effects": {"segment_piston": {"piston_nm": PISTON_NM.tolist()}},
}
SPEC = {
    "simulation": "segments",
    "instrument": "nirc2_narrow",
    "seed": 3,
    "ncpa": {"total_nm": 80, "modes": 30},
    "detector": {"e_per_adu": 4.0, "read_noise_e": 60.0},
    "diversity": {"source": "lens", "zernike": {6: -170.0}},
    "recordings": {"cube": CUBE},
}


@pytest.mark.long
def test_segments_out_of_step_are_named_with_their_pistons_and_nothing_else_is(tmp_path):
    simulated(tmp_path / "sky", SPEC)
    run = tmp_path / "run"
    told = ["--set", "instrument=nirc2_narrow", "--input", f"cube={tmp_path / 'sky' / 'data' / 'cube'}"]
    ran = CliRunner().invoke(cli, ["run", "recipes/diagnose_bench.yaml", *told, "--output", str(run)])
    assert ran.exit_code == 0, ran.output
    found = json.loads((run / "results.json").read_text())["stages"]["diagnose"]
    assert (found["verdict"], found["grade"]) == ("effect", "complete")
    (step,) = found["steps"]
    assert step["effect"] == "segment_piston"
    error = np.array(step["parameters"]["piston_nm"]) - (PISTON_NM - PISTON_NM.mean())
    pulls = (error - error.mean()) / step["sigma"]["piston_nm"]  # piston of all does nothing
    # Tip, tilt and the lowest modes of the segments are those of the NCPAs, which have a prior.
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.5
