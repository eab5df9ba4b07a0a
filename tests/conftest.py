"""Fixtures shared by the tests."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from helpers import fake_stages

from irlos_pipe.commands.main import cli

RECIPE = """\
recipe: test
title: a recipe of stand-ins
inputs:
  cube: data
stages: [ingest, calibrate, lift]
calibrate:
  method: dip_avg
"""


@dataclass
class Bench:
    """A recipe of stand-in stages with its input and its run folder."""

    folder: Path

    @property
    def recipe(self) -> Path:
        return self.folder / "recipe.yaml"

    @property
    def data(self) -> Path:
        return self.folder / "data"

    @property
    def output(self) -> Path:
        return self.folder / "out"

    def run(self, *options: str) -> Result:
        """Run ``irlos run`` on the recipe."""
        return invoke("run", str(self.recipe), "--output", str(self.output), "--device", "cpu", *options)

    def make(self, behaviour: str) -> None:
        """Make a stage misbehave, for example ``calibrate.crash``."""
        (self.data / behaviour).touch()


def invoke(*arguments: str) -> Result:
    """Run the command line in this process."""
    return CliRunner().invoke(cli, list(arguments))


@contextmanager
def without_report() -> Iterator[None]:
    """Leave out the report, whose drawings take half of the time of a small run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("irlos_pipe.report.build.write_report", lambda *_: None)
        yield


def products(folder: Path) -> list[str]:
    """Names of the products in a run folder."""
    return sorted(path.name for path in folder.glob("*.h5"))


@pytest.fixture
def bench(tmp_path, monkeypatch) -> Bench:
    """Stand-in stages, a recipe for them, and data; nothing has run yet."""
    for name, module in fake_stages.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    fake_stages.COUNTS.clear()
    bench = Bench(tmp_path)
    bench.recipe.write_text(RECIPE)
    bench.data.mkdir()
    (bench.data / "a.dat").write_bytes(b"12345")
    (bench.data / "b.dat").write_bytes(b"123")
    return bench


def pytest_configure():
    """Let Ctrl-C end the processes that tests start: a suite in the background makes them ignore it."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
