"""Run the experiments one after the other; one that fails does not stop the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import ExitCode, IrlosError
from irlos_pipe.conventions.text import aligned
from irlos_pipe.paper.run.collect import TABLES, collect_numbers, collect_reports, require_size
from irlos_pipe.paper.run.recipes import Experiment
from irlos_pipe.pipeline import Outcome, Resources, run_recipe
from irlos_pipe.pipeline.runlog import RUN
from irlos_pipe.pipeline.terminal import quality_line
from irlos_pipe.product.runfolder import owned_folder, require_free

OF_THE_PAPER = (TABLES, "*/recipe.resolved.yaml")


@dataclass(frozen=True)
class PaperRun:
    """Outcome of the run of all experiments.

    Attributes
    ----------
    outcomes : dict of str to Outcome
        Of those that came to an end.
    problems : dict of str to str
        What stopped the others.
    report, numbers : Path
        The report, and the folder of the numbers of all experiments.
    """

    outcomes: dict[str, Outcome]
    problems: dict[str, str]
    report: Path
    numbers: Path

    @property
    def exit_code(self) -> int:
        """Return 0, or 5 when an experiment failed or lost a part, or 4 when a QC limit failed."""
        codes = {outcome.exit_code for outcome in self.outcomes.values()}
        if self.problems or codes - {ExitCode.DONE, ExitCode.QUALITY}:
            return ExitCode.PARTIAL
        return max(codes, default=ExitCode.DONE)


def run_paper(known: Sequence[Experiment], folder: Path, quick: bool, resources: Resources) -> PaperRun:
    """Bring the wanted experiments up to date, each in a folder of its own, and collect all of them.

    Parameters
    ----------
    known : sequence of Experiment
        In the order of the paper; those not wanted are collected when they are up to date.
    folder : Path
        Made if it does not exist.
    quick : bool
        Whether their samples are small.
    resources : Resources
        Processes, and what is shown while they work.

    Raises
    ------
    ConfigurationError
        When the folder holds experiments of the other size.
    Locked, IrlosError
        When the folder is in use, or cannot be written.
    """
    require_free(folder, OF_THE_PAPER)
    require_size(folder, quick)
    wanted = [one for one in known if one.wanted]
    outcomes, problems = {}, {}
    with owned_folder(folder):
        for number, experiment in enumerate(wanted, 1):
            name = experiment.name
            RUN.info("experiment %d of %d: %s", number, len(wanted), name)
            try:
                outcome = run_recipe(experiment.recipe, folder / name, None, resources)
            except IrlosError as error:
                problems[name] = str(error).splitlines()[0]
                RUN.warning("%s: failed: %s", name, error)
            else:
                outcomes[name] = outcome
                if outcome.report_error:
                    RUN.warning("%s: %s", name, outcome.report_error)
            # After each experiment, so that the numbers so far can be looked at.
            numbers = collect_numbers(known, folder, quick)
        report = collect_reports(known, folder, quick, problems)
    return PaperRun(outcomes, problems, report, numbers)


def summary_text(ran: PaperRun) -> str:
    """Return the summary lines of every experiment and where the files are, for the terminal."""
    rows = [(name, line) for name, outcome in ran.outcomes.items() for line in _lines(outcome)]
    rows += [(name, f"failed: {problem}") for name, problem in ran.problems.items()]
    rows += [("report", str(ran.report)), ("numbers", str(ran.numbers))]
    return aligned(rows)


def _lines(outcome: Outcome) -> list[str]:
    quality = f", {quality_line(outcome)}" if outcome.quality["checks"] else ""
    summary = [line for lines in outcome.summary.values() for line in lines]
    return [outcome.status.replace("_", " ") + quality, *summary]
