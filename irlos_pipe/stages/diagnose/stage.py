"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from irlos_pipe.conventions.late import LateModule
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.diagnosis.options import DRIFT_NM
from irlos_pipe.files.regular import read_regular
from irlos_pipe.product.results import item
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.diagnose.results import ARRAYS, CHECKS
from irlos_pipe.stages.diagnose.results import DiagnoseResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "diagnose"
VERSION = 33
NEEDS = ("ingest",)
READS = ("ingest", "calibrate", "lift")
WORK = LateModule("irlos_pipe.stages.diagnose.work")
Noll = Annotated[int, Field(ge=2, le=HIGHEST_NOLL)]
Nanometres = Annotated[float, Field(ge=-5000, le=5000)]


def _wavefront_of(value: Any) -> Any:
    """Return coefficients as they are, Noll index to nm RMS, and those in the results of a run for its path.

    That is a run folder or its ``results.json``: of its diagnosis the wavefront with what was found, else
    that of its calibration. A ValueError says where none can be read.
    """
    if not isinstance(value, str):
        return value
    path = Path(value)
    path = RunFolder(path).results if path.is_dir() else path
    try:
        stages = json.loads(read_regular(path))["stages"]
    except OSError as error:
        raise ValueError(
            f"{path}: {error.strerror or error}; give a run folder or its results.json"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: no results of a run; give a run folder or its results.json") from None
    if "diagnose" in stages and "zernike_nm" in stages["diagnose"]:
        return stages["diagnose"]["zernike_nm"]["after"]
    if "calibrate" in stages:
        return stages["calibrate"]["all_zernike_nm"]
    raise ValueError(f"{path}: no calibration and no diagnosis of a cube; give a run that has one")


class Config(StageConfig):
    """Settings of the diagnosis."""

    input: str = item("cube", "recipe input that holds the cubes, or the ramp")
    highest_noll: int = item(
        66, "modes 2 to this belong to every model; beyond: high_order_ncpa", ge=4, le=HIGHEST_NOLL
    )
    held_out: float = item(
        0.25, "part of the frames, or of the pixels of fewer than 16, that no fit sees", gt=0.05, le=0.5
    )
    most_names: int = item(4, "names at which to stop, of each star and night", ge=1, le=10)
    recordings: Literal["auto", "together", "apart"] = item(
        "auto", "of one star and night (together), each of its own (apart), or as targets and times tell"
    )
    night_drift_nm: float = item(
        DRIFT_NM, "prior σ of the change of every mode between stars and nights [nm]", gt=0, le=100
    )
    sure_sigma: float = item(5.0, "significance of a detection", ge=3, le=20)
    begin_near: Annotated[dict[Noll, Nanometres], BeforeValidator(_wavefront_of)] = item(
        {},
        "a wavefront from which the fit begins as well, Noll index to nm RMS, or the path of a "
        "run that found it in another recording",
    )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    return WORK.run(ctx)
