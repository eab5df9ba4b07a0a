"""Run recipes from Python, and look at what they left."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from irlos_pipe.conventions.text import aligned, suggestion
from irlos_pipe.pipeline import Resources, Selection, run_recipe
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.results import LOST, RunResults, read_run_results
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages.model.untested import NOT_TESTED


class Run(Mapping[str, Product]):
    """A finished run in the folder `path`: its products by stage, in the order of the recipe.

    Raises
    ------
    InputDataError
        When it is not the folder of a run.
    """

    def __init__(self, path: Path | str) -> None:
        run = existing_run(Path(path))
        self.path = run.path
        self.files = {file.stem.partition("_")[2]: file for file in run.product_files}
        self._opened: dict[str, Product] = {}

    def __getitem__(self, stage: str) -> Product:
        """Return the product of a stage; its arrays are read on access."""
        if stage not in self.files:
            raise KeyError(f"{self.path}: no product of '{stage}'{suggestion(stage, self.files)}")
        if stage not in self._opened:
            self._opened[stage] = open_product(self.files[stage])
        return self._opened[stage]

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)

    @cached_property
    def results(self) -> RunResults:
        """Content of results.json."""
        return read_run_results(RunFolder(self.path).results)

    @property
    def checks(self) -> list[Check]:
        """The quality checks of all stages."""
        return [check for product in self.values() for check in product.checks]

    def figures(self) -> dict[str, Figure]:
        """Return the figures of the report by name, drawn again, see `figures`."""
        from irlos_pipe.report.build import figures

        return figures(self.path)

    def figure(self, name: str, axes: Axes | None = None) -> FigureBase:
        """Return one of them, drawn by itself or on Matplotlib `axes`.

        Raises `ConfigurationError` for an unknown name, and for a figure of several axes on `axes`.
        """
        from irlos_pipe.report.build import figure

        return figure(self.path, name, axes)

    def __repr__(self) -> str:
        """Say what was run, and what came out of it."""
        failed = [check.name for check in self.checks if not check.passed]
        quality = f"{len(self.checks) - len(failed)} of {len(self.checks)} checks passed"
        rows = [row for stage, product in self.items() for row in _rows(stage, product)]
        head = f"Run {self.path}: recipe {self.results.recipe}, {self.results.status}, {quality}"
        return "\n".join([head, aligned(rows), *(f"  failed: {name}" for name in failed)])


def _rows(stage: str, product: Product) -> list[tuple[str, str, str]]:
    """How many checks passed, the headline, and after it what was not tested and what was lost."""
    headline, *more = product.summary or [""]
    quality = f"{sum(check.passed for check in product.checks)}/{len(product.checks)}"
    missing = [line for line in more if line.startswith((NOT_TESTED, LOST))]
    return [(f"  {stage}", quality, headline), *(("", "", line) for line in missing)]


def run(
    recipe: Recipe,
    output: Path | str,
    *,
    first: str | None = None,
    last: str | None = None,
    force: bool = False,
    device: str = "cpu",
    jobs: int = 1,
) -> Run:
    """Bring the products of a recipe up to date, as ``irlos run`` does.

    Parameters
    ----------
    recipe : Recipe
        From `load_recipe`.
    output : Path or str
        The run's folder; made if it does not exist.
    first, last : str, optional
        First and last stage to run; all by default.
    force : bool
        Run stages even if their products are up to date.
    device : str
        ``cpu``, ``cuda`` or ``auto``.
    jobs : int
        Number of workers, threads and processes.

    Raises
    ------
    Locked
        When another run owns the folder.
    IrlosError
        When a stage cannot do its work; products of finished stages stay. Failed quality checks raise
        nothing: see `Run.checks`.
    """
    run_recipe(recipe, Path(output), Selection(first, last, force), Resources(device=device, jobs=jobs))
    return Run(output)


def open_run(path: Path | str) -> Run:
    """Return the finished run in the folder `path`.

    Raises
    ------
    InputDataError
        When it is not the folder of a run.
    """
    return Run(path)
