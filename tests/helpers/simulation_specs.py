"""Small simulation specs for tests, and shorthands to run them."""

import json
from pathlib import Path

from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.simulate.recordings.files import Planned
from irlos_pipe.simulate.recordings.run import simulate
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings

COARSE = {"pupil_samples": 32, "points_per_band": 1, "step_s": 0.1}
CUBE = {"role": "ncpa_calibration", "mag_j": 9.0, "frames": 3, "exposure_s": 0.1, "window": [24, 24]}
RAMP = {
    "role": "defocus_ramp",
    "mag_j": 12.0,
    "frames": 2,
    "exposure_s": 1.0,
    "bands": "j_h",
    "window": [24, 24],
    "offsets_nm": [-200, 0, 200],
}


def spec_of(recordings: dict, **top) -> dict:
    """A spec without sky, computed coarsely."""
    base = {"simulation": "test", "seed": 5, "sampling": COARSE, "diversity": {"zernike": {6: -170.0}}}
    return base | {"recordings": recordings} | top


def written(path: Path, spec: dict) -> Path:
    path.write_text(yaml_text(spec))
    return path


def planned(folder: Path, recordings: dict, *settings: str, **top) -> dict[str, Planned]:
    spec = load_spec(written(folder / "spec.yaml", spec_of(recordings, **top)), settings)
    return {one.name: one for one in plan_recordings(spec)}


def simulated(folder: Path, spec: dict, **options):
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = written(folder.parent / f"{folder.name}.yaml", spec)
    return simulate(load_spec(path), folder, **options)


def truth(folder: Path, name: str) -> dict:
    return json.loads((folder / "truth" / f"{name}.json").read_text())
