"""Samples for tests of `run_samples`, and the command line with a stage that runs some of them.

A folder is the tests' window on the workers: every computed sample leaves ``<name>.done`` there,
and one for which ``<name>.hold`` exists says ``<name>.waiting`` and goes on when it is gone.
"""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from helpers import fake_stages
from helpers.stage_context import stage_context
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.paper.common.ensemble import run_samples
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

NAMES = ("a", "b", "c", "d")


@dataclass(frozen=True)
class Draw:
    """A sample: some random numbers of a seed."""

    name: str
    seed: int
    folder: str


def draw(sample: Draw) -> list[dict]:
    """Numbers whose last bits depend on the order of the sums, and so on the number of threads."""
    folder = Path(sample.folder)
    if (folder / f"{sample.name}.hold").exists():
        (folder / f"{sample.name}.waiting").touch()
    while (folder / f"{sample.name}.hold").exists():
        time.sleep(0.02)
    matrix = np.random.default_rng(sample.seed).normal(size=(300, 300))
    (folder / f"{sample.name}.done").touch()
    return [{"product": matrix @ matrix, "trace": np.trace(matrix), "name": sample.name}]


def refuse(sample: Draw) -> list[dict]:
    if sample.seed == 2:
        raise InputDataError("no star in the window")
    return [{"seed": sample.seed}]


def die(sample: Draw) -> list[dict]:
    """End the worker as the kernel does when memory runs out."""
    if sample.seed == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return [{"seed": sample.seed}]


def threads(sample: Draw) -> list[dict]:
    """The numbers of threads that the numerical libraries would use."""
    import torch

    return [{"torch": torch.get_num_threads(), "omp": os.environ["OMP_NUM_THREADS"], "process": os.getpid()}]


def draws(folder: Path, names=NAMES) -> list[Draw]:
    return [Draw(name, seed, str(folder)) for seed, name in enumerate(names)]


def computed(folder: Path) -> list[str]:
    """Names of the samples computed since the last call."""
    marks = sorted(folder.glob("*.done"))
    for mark in marks:
        mark.unlink()
    return [mark.stem for mark in marks]


def context(scratch: Path, jobs: int = 2) -> StageContext:
    """The context of a stage that looks only at its scratch folder and its jobs."""
    return stage_context(StageConfig(), jobs=jobs, scratch=scratch)


def lift(ctx: StageContext) -> StageOutput:
    """A stage that draws samples; its marks lie next to the input."""
    found = run_samples(draw, draws(ctx.inputs["cube"][0].parent / "marks"), ctx, "draws")
    traces = np.array([one["trace"] for (one,) in found])
    return StageOutput({"traces": Quantity(traces, "")}, fake_stages.FreeResults(traces=traces.tolist()))


if __name__ == "__main__":
    # The command line with the stand-ins, for tests that end a process.
    sys.modules |= fake_stages.modules()
    from helpers import ensemble_cases  # under its name in the tests, which is part of the samples' keys

    sys.modules["irlos_pipe.stages.lift.stage"].run = ensemble_cases.lift
    from irlos_pipe.commands.main import cli

    cli(prog_name="irlos")
