"""Small stages that stand in for the real ones, so that the pipeline is tested on its own.

They take the place of the modules ``irlos_pipe.stages.ingest``, ``calibrate`` and ``lift``.
`COUNTS` says how often each ran; files named ``<stage>.<behaviour>`` in the input folder make
a stage misbehave: ``crash``, ``bad_data``, ``nothing``, ``fail_qc``, ``lose_exposure``,
``missing_file``, ``interrupt``, ``disk_full``.
"""

import errno
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.product.results import StageResults
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput


class FreeResults(StageResults):
    """Results of a stage that stands in for a real one, with any keys."""

    model_config = ConfigDict(extra="allow")
    stage: ClassVar[str] = "any"


class MethodResults(FreeResults):
    """Those of a stage that states its method."""

    method: str = ""


COUNTS: Counter[str] = Counter()


class IngestConfig(StageConfig):
    scale: float = Field(1.0, gt=0, description="factor on the counts")


class Solver(BaseModel):
    model_config = ConfigDict(extra="forbid")

    iterations: int = Field(20, ge=1, description="largest number of iterations")


class CalibrateConfig(StageConfig):
    method: Literal["dip_avg", "dip_global"] = Field("dip_avg", description="how NCPAs are estimated")
    jitter_sigma_mas: float = Field(5.0, ge=0, le=100, description="image motion [mas]")
    solver: Solver = Solver()


class LiftConfig(StageConfig):
    calibrated: bool = Field(True, description="take the NCPAs of calibrate into account")


def ingest(ctx: StageContext) -> StageOutput:
    counts = np.array([len(path.read_bytes()) for path in sorted(data_folder(ctx).glob("*.dat"))], float)
    counts = counts * ctx.config.scale
    ctx.log.info("read %d files", counts.size)
    return StageOutput(
        {"counts": Quantity(counts, "ADU")},
        FreeResults(total=counts.sum(), spread=float("nan")),
        summary=[f"{counts.size} files"],
    )


def calibrate(ctx: StageContext) -> StageOutput:
    mean = ctx.products["ingest"].arrays["counts"].value.mean()
    return StageOutput(
        {"mean": Quantity(np.asarray(mean), "ADU")},
        MethodResults(method=ctx.config.method),
        checks=[Check("mean", mean, "ADU", 0, None, "counts are positive")],
        files={"table.csv": b"mode,nm\n"},
        summary=[f"mean {mean:g} ADU"],
    )


def lift(ctx: StageContext) -> StageOutput:
    draws = np.random.default_rng(ctx.seed).normal(size=3)
    return StageOutput({"draws": Quantity(draws, "nm", error=np.ones(3))}, FreeResults(first=draws[0]))


def data_folder(ctx: StageContext) -> Path:
    return ctx.inputs["cube"][0]


def _fail_qc(output: StageOutput) -> StageOutput:
    return StageOutput(
        output.arrays, output.results, checks=[Check("chi2", 9.0, "", 0.5, 1.5, "the model does not fit")]
    )


def _lose_exposure(output: StageOutput) -> StageOutput:
    return StageOutput(output.arrays, output.results, failures=["exposure 3: no star"])


def misbehave(name: str, folder: Path) -> None:
    wanted = {path.suffix[1:] for path in folder.glob(f"{name}.*")}
    errors = {
        "crash": ZeroDivisionError("a bug"),
        "bad_data": InputDataError("cube.fits: HDU 1 is truncated"),
        "nothing": NothingToDo("no recordings found"),
        "interrupt": KeyboardInterrupt(),
        "missing_file": FileNotFoundError(errno.ENOENT, "No such file or directory", "x.fits"),
        "disk_full": OSError(errno.ENOSPC, "No space left on device"),
    }
    for behaviour in wanted & errors.keys():
        raise errors[behaviour]


def _module(name: str, config: type[StageConfig], work, **extra) -> ModuleType:
    real = import_module(f"irlos_pipe.stages.{name}.stage")
    module = ModuleType(real.__name__)
    module.__dict__.update({name: one for name, one in vars(real).items() if isinstance(one, type)})

    def run(ctx: StageContext) -> StageOutput:
        COUNTS[name] += 1
        misbehave(name, data_folder(ctx))
        output = work(ctx)
        for behaviour, change in {"fail_qc": _fail_qc, "lose_exposure": _lose_exposure}.items():
            if (data_folder(ctx) / f"{name}.{behaviour}").exists():
                output = change(output)
        return output

    declared = {"Results": FreeResults} | extra
    module.__dict__.update(VERSION=1, Config=config, run=run, **declared)
    return module


def modules() -> dict[str, ModuleType]:
    """Fresh stand-ins by the name of the module they replace."""
    stages = [
        _module("ingest", IngestConfig, ingest, DEPENDS_ON={"inputs", "instrument"}),
        _module("calibrate", CalibrateConfig, calibrate, NEEDS=("ingest",), Results=MethodResults),
        _module("lift", LiftConfig, lift, NEEDS=("ingest",), DEPENDS_ON={"seed"}),
    ]
    return {stage.__name__: stage for stage in stages} | {"irlos_pipe.report.build": report_module()}


def report_module() -> ModuleType:
    module = ModuleType("irlos_pipe.report.build")

    def write_report(folder: Path, jobs: int = 1) -> Path:
        COUNTS["report"] += 1
        (folder / "report.html").write_text("<html></html>")
        return folder / "report.html"

    module.write_report = write_report
    module.report_sections = lambda run: []
    module.FORMATS, module.write_figures = (), lambda run, formats: []
    return module


if __name__ == "__main__":
    # The command line with the stand-ins, for tests at a terminal.
    sys.modules |= modules()
    from irlos_pipe.commands.main import cli

    cli(prog_name="irlos")
