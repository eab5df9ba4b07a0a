"""Run the stage of an experiment on samples that are there already, and build its section of the report."""

from collections.abc import Callable

from helpers import optics_cases as cases
from helpers.stage_context import stage_context
from irlos_pipe.paper import experiment
from irlos_pipe.paper.experiment import Sample
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import RunResults
from irlos_pipe.report.content import Section
from irlos_pipe.report.run_data import RunData
from irlos_pipe.stages.base import StageContext, StageOutput


def context(config, seed: int = 5) -> StageContext:
    return stage_context(config, seed=seed)


def sample(module, seed: tuple[int, ...] = (31, 0), facility=cases.FACILITY, sizes=None, **of) -> Sample:
    """Return a sample of an experiment's module, its sizes and what it has of its own as given."""
    return Sample("test", seed, facility, module.Sizes(**(sizes or {})), of)


def run_on(monkeypatch, module, rows_of: Callable, seed: int = 5, **sizes) -> StageOutput:
    """Return the output of an experiment whose samples give the rows ``rows_of(sample)``."""
    monkeypatch.setattr(
        experiment,
        "run_samples",
        lambda function, samples, ctx, desc: [list(rows_of(one)) for one in samples],
    )
    return module.EXPERIMENT.run(context(module.Sizes(**sizes), seed))


def tables_of(output: StageOutput) -> dict:
    return output.results.frames()


def missed(output: StageOutput) -> list[str]:
    return [check.name for check in output.checks if not check.passed]


def section_of(output: StageOutput, name: str, build: Callable[[RunData], Section], config=None) -> Section:
    """Build the section of a stage's output as it is read back from its product."""
    settings = config.model_dump() if config else {}
    product = Product(name, output.arrays, output.results.as_json(), config=settings)
    return build(RunData({}, "", RunResults(), {name: product}, []))


def drawn(output: StageOutput, module, **sizes) -> Section:
    """Build the section of the output of an experiment's module, run with some sizes of its own."""
    own = module.EXPERIMENT
    return section_of(output, own.NAME, own.section, module.Sizes(**sizes))
