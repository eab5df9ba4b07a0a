"""A folder of recipes of stand-in stages, as `irlos paper` runs them."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from click.testing import Result
from conftest import invoke
from pydantic import Field

import irlos_pipe.report.figures  # noqa: F401 - before a stand-in takes the place of what it imports
from helpers import fake_stages
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.paper.common.table import read_csv
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.report import build
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import svg
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

RECIPE = """\
recipe: {name}
title: The {name} experiment
stages: [{stage}]
{stage}:
  samples: 200
seed: 3
"""
QUICK = """\
zeta: {calibrate.samples: 10}
alpha: {lift.samples: 20, seed: 4}
"""


class Config(StageConfig):
    samples: int = Field(5, ge=1)
    limit: float = Field(10.0, description="largest mean that passes")
    fails: bool = False


def run(ctx: StageContext) -> StageOutput:
    """Draw numbers; two stages of a recipe folder do the same under two names."""
    fake_stages.COUNTS[ctx.log.name.rpartition(".")[2]] += 1
    if ctx.config.fails:
        raise InputDataError("the star is gone")
    draws = np.random.default_rng(ctx.seed).normal(size=ctx.config.samples)
    check = Check("mean", draws.mean(), "nm", None, ctx.config.limit, "the mean is small")
    rows = [{"name": "a", "median_nm": float(np.median(draws))}]
    results = fake_stages.FreeResults(mean_nm=draws.mean(), tables={"draws": rows})
    return StageOutput({"draws": Quantity(draws, "nm")}, results, [check], summary=["a few draws"])


def section(data) -> Section:
    """The same drawing for every experiment that has this stage."""
    line = svg("line", (3, 2), lambda figure: figure.subplots().plot([0, 1], label="line"))
    mean = f"{data.products['lift'].results['mean_nm']:.4f} nm"
    return Section("lift", "Draws", "Some draws.", [Figure(line, "A line"), Table(("mean",), [(mean,)])])


@dataclass
class PaperBench:
    """Recipes `zeta` (stage calibrate) and `alpha` (stage lift), and where they run."""

    folder: Path

    @property
    def recipes(self) -> Path:
        return self.folder / "recipes"

    @property
    def output(self) -> Path:
        return self.folder / "out"

    def paper(self, *options: str) -> Result:
        return invoke(
            "paper", "--output", str(self.output), "--recipes", str(self.recipes), "--jobs", "1", *options
        )

    def numbers(self) -> dict[str, str]:
        """Files of numbers by name, but for the one that changes from run to run."""
        files = sorted((self.output / "tables").glob("*.csv"))
        return {file.stem: file.read_text() for file in files if file.stem != "runs"}

    def runs(self) -> list[dict[str, str]]:
        return read_csv(self.output / "tables/runs.csv")

    def page(self) -> str:
        return (self.output / "report.html").read_text()

    def set(self, name: str, line: str) -> None:
        path = self.recipes / f"{name}.yaml"
        path.write_text(path.read_text().replace("  samples", f"  {line}\n  samples"))


def make(folder: Path, monkeypatch) -> PaperBench:
    """Put the stand-ins in place and write the recipes; file names are not in the order of the stages."""
    modules = fake_stages.modules()
    for name in ("calibrate", "lift"):
        module = modules[f"irlos_pipe.stages.{name}.stage"]
        module.__dict__.update(Config=Config, run=run, NEEDS=(), READS=(), DEPENDS_ON={"seed"})
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(build, "SECTIONS", {"lift": section})
    fake_stages.COUNTS.clear()
    bench = PaperBench(folder)
    bench.recipes.mkdir()
    for name, stage in (("zeta", "calibrate"), ("alpha", "lift")):
        (bench.recipes / f"{name}.yaml").write_text(RECIPE.format(name=name, stage=stage))
    (bench.recipes / "quick.yaml").write_text(QUICK)
    return bench
