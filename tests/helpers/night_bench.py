"""Nights of small recordings, and recipes of stand-in stages to reduce them with, all in this process."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup

import irlos_pipe.report.build  # noqa: F401 - before a stand-in takes the place of what it imports
from helpers import fake_stages
from helpers.fake_stages import COUNTS
from helpers.patience import within
from helpers.sparta_files import counts, star, write_recorder
from irlos_pipe.estimate.ramp import Line
from irlos_pipe.night import trend_plots
from irlos_pipe.night.run import Request, run_night
from irlos_pipe.night.settings import load_settings
from irlos_pipe.night.state import RunState
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import IngestResults
from irlos_pipe.stages.lift.stage import LiftResults, Point

CUBE = """\
recipe: cube
inputs: {calibration: data}
stages: [ingest, calibrate, lift]
"""
RAMP = """\
recipe: ramp
inputs: {ramp: data, calibration: data}
stages: [ingest, calibrate, lift]
"""
PIXELS = counts(star(12, 12), frames=2)
FLAT_NUMBERS = {"4": 30.0, "5": -10.0}


class Config(StageConfig):
    limit: float = 100.0


def _folder(ctx: StageContext) -> Path:
    return next(iter(ctx.inputs.values()))[0]


def _begin(name: str, ctx: StageContext) -> None:
    COUNTS[name] += 1
    fake_stages.misbehave(name, _folder(ctx))


def ingest(ctx: StageContext) -> StageOutput:
    _begin("ingest", ctx)
    failures = ["exposure 3: no star"] if (_folder(ctx) / "ingest.partial").exists() else []
    return StageOutput({"x": Quantity(np.arange(3.0), "")}, IngestResults(inputs=[]), failures=failures)


def calibrate(ctx: StageContext) -> StageOutput:
    """Report the numbers in the file next to the recording."""
    _begin("calibrate", ctx)
    numbers = json.loads((_folder(ctx) / "numbers.json").read_text())
    results = CalibrateResults(
        zernike_nm=numbers, sigma_nm=dict.fromkeys(numbers, 0.5), wfe_nm=50.0, seeing_arcsec=0.5
    )
    largest = max(numbers.values())
    return StageOutput({}, results, [Check("largest", largest, "nm", None, ctx.config.limit, "small")])


def lift(ctx: StageContext) -> StageOutput:
    _begin("lift", ctx)
    line = Line(offset_nm=2.5, slope=0.99, slope_sigma=0.01, rms_nm=4.0, residual_rms_nm=3.0)
    return StageOutput({}, LiftResults(summary=line, points=[Point()] * 9))


@dataclass
class NightBench:
    """An archive with its tree of results."""

    folder: Path

    @property
    def archive(self) -> Path:
        return self.folder / "archive"

    @property
    def tree(self) -> Path:
        return self.folder / "tree"

    @property
    def recipes(self) -> Sequence[str]:
        return [
            f"{kind}={self.folder / file}"
            for kind, file in (("calibration", "cube.yaml"), ("ramp", "ramp.yaml"))
        ]

    def night(self, date: str) -> Path:
        return self.archive / date

    def record(self, moment: str, name: str = "cube", numbers: dict | None = None, **keys) -> Path:
        """Write a recording taken at an ISO moment into the folder of its night; returns its folder."""
        unix_s = int(datetime.fromisoformat(f"{moment}+00:00").timestamp())
        folder = self.night(moment[:10]) / name
        times = {"Seconds": unix_s + np.arange(2), "USeconds": np.zeros(2, int)}
        write_recorder(folder, PIXELS, times=times, keys=keys)
        (folder / "numbers.json").write_text(json.dumps(numbers or FLAT_NUMBERS))
        return folder

    def request(self, *folders: Path, since: str = "") -> Request:
        return Request(folders or [self.archive], self.tree, load_settings(None, self.recipes), since)

    def run(self, *folders: Path, since: str = "") -> RunState:
        return run_night(self.request(*folders, since=since), lambda work, tasks: map(work, tasks))

    def run_folder(self, night: str = "2024-02-10", group: str = "030000_cube", recipe: str = "cube") -> Path:
        return self.tree / night / group / recipe

    def page(self, night: str = "2024-02-10") -> str:
        return (self.tree / f"night_{night}.html").read_text()


@pytest.fixture(name="bench")
def night_bench(tmp_path, monkeypatch) -> NightBench:
    """An empty archive; nothing is drawn, which takes most of the time of a small night, or hangs."""
    for name in ("series_drawing", "structure_drawing"):
        monkeypatch.setattr(trend_plots, name, lambda name, _: Markup("<svg></svg>"))
    with within(60):
        yield make(tmp_path, monkeypatch)


def make(folder: Path, monkeypatch) -> NightBench:
    """Install the stand-in stages; the archive is empty."""
    modules = fake_stages.modules()
    for name, work in (("ingest", ingest), ("calibrate", calibrate), ("lift", lift)):
        modules[f"irlos_pipe.stages.{name}.stage"].__dict__.update(Config=Config, run=work)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    COUNTS.clear()
    bench = NightBench(folder)
    bench.archive.mkdir()
    (folder / "cube.yaml").write_text(CUBE)
    (folder / "ramp.yaml").write_text(RAMP)
    return bench
