"""Section on the seeing scales of SPARTA and of a seeing monitor."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.seeing_scales.experiment import log_normal_density
from irlos_pipe.paper.seeing_scales.results import ConditionRow, SeeingScalesResults
from irlos_pipe.paper.seeing_scales.stage import Config
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, FAINT, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number

STAGE = SeeingScalesResults.stage
SIZE_IN = (4.4, 3.2)
BINS = 60
COLUMNS = (
    "condition",
    'SPARTA ["]',
    'monitor ["]',
    "better than",
    "AO residual [nm RMS]",
    "if not translated",
    "too high by",
)
MARKERS = {"simulation": "o", "sky": "s"}


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(SeeingScalesResults)
    monitor, sparta = (array_of(run, STAGE, f"draws/{name}_arcsec") for name in ("monitor", "sparta"))
    config = Config.model_validate(run.products[STAGE].config)
    blocks: list[Block] = [
        Figure(_distributions(monitor, sparta, config), "How often each sees what", DRAWN, "third"),
        Figure(_mapping(results, config), "From one scale to the other", MAPPED, "third"),
        Figure(_residual(results, config), "What it means for the AO residual", LAW, "third"),
        _table(results),
    ]
    return Section(STAGE, "Seeing by SPARTA and by a seeing monitor", _lead(results), blocks)


DRAWN = "Histograms of the draws; line: the log-normal distribution from which the monitor's are drawn."
MAPPED = "Line: relation, band: 1σ of the disagreement, grey: equal scales. Dots: simulated, squares: on sky."
LAW = "The residual's law is stated for SPARTA's seeing; a monitor's put into it gives too large a residual."


def _lead(results: SeeingScalesResults) -> str:
    relation, found = results.relation, results.distributions
    medians = [one.median for one in (found.wfe_nm, found.wfe_untranslated_nm)]
    return (
        f"SPARTA = {relation.ratio:.2f} · {results.monitor} {relation.offset_arcsec:+.2f} arcsec "
        f"({relation.status}: {relation.source}). The median AO residual is then {medians[0]:.0f} nm "
        f"RMS; the monitor's seeing taken for SPARTA's would make it {medians[1]:.0f} nm."
    )


def _range(results: SeeingScalesResults) -> np.ndarray:
    """Seeing by the monitor, as far as anything is drawn."""
    shown = [row.monitor_arcsec for row in results.conditions]
    last = max(*shown, 2 * results.distributions.monitor_arcsec.p84) if shown else 2.0
    return np.linspace(0.2, 1.1 * last, 100)


def _distributions(monitor: np.ndarray, sparta: np.ndarray, config: Config) -> Markup:
    edges = np.linspace(0, np.percentile(monitor, 99.5), BINS)

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for values, colour, label in ((monitor, ORANGE, config.monitor), (sparta, BLUE, "SPARTA")):
            axes.hist(values, edges.tolist(), density=True, color=colour, alpha=0.35, label=label)
            axes.axvline(np.median(values), color=colour)
        middle = (edges[1:] + edges[:-1]) / 2
        density = log_normal_density(middle, config.median_arcsec, config.scatter)
        axes.plot(middle, density, color=ORANGE)
        axes.set(xlabel='seeing ["]', ylabel='probability density [1/"]')
        axes.legend()

    return svg("seeing-distributions", SIZE_IN, draw)


def _mapping(results: SeeingScalesResults, config: Config) -> Markup:
    monitor = _range(results)
    sparta, factor = results.relation.scale.to_sparta(monitor), np.exp(config.disagreement)

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(monitor, monitor, color=FAINT)
        axes.fill_between(monitor, sparta / factor, sparta * factor, color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(monitor, sparta, color=BLUE)
        for row in results.conditions:
            axes.plot(row.monitor_arcsec, row.sparta_arcsec, MARKERS[row.where], color=INK)
        axes.set(xlabel=f'{config.monitor} ["]', ylabel='SPARTA ["]')

    return svg("seeing-mapping", SIZE_IN, draw)


def _residual(results: SeeingScalesResults, config: Config) -> Markup:
    monitor = _range(results)
    sparta, factor = results.relation.scale.to_sparta(monitor), np.exp(config.disagreement)

    def draw(figure: Canvas) -> None:
        axes, law = figure.subplots(), results.residual_law
        band = (law.wfe_nm(sparta / factor), law.wfe_nm(sparta * factor))
        axes.fill_between(monitor, *band, color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(monitor, law.wfe_nm(sparta), color=BLUE, label="translated")
        axes.plot(monitor, law.wfe_nm(monitor), color=ORANGE, label="taken as it is")
        axes.set(xlabel=f'{config.monitor} ["]', ylabel="AO residual [nm RMS]")
        axes.legend()

    return svg("seeing-residual", SIZE_IN, draw)


def _table(results: SeeingScalesResults) -> Table:
    caption = (
        "Errors: 1σ of the disagreement between the two, where only the monitor's seeing is known. "
        "Better than: part of the time with a seeing, by SPARTA, above this one."
    )
    return Table(COLUMNS, [_row(row) for row in results.conditions], "The paper's conditions", caption)


def _row(row: ConditionRow) -> tuple[str, ...]:
    error = f" ± {row.wfe_sigma_nm:.0f}" if row.where == "sky" else ""
    return (
        "simulated" if row.where == "simulation" else "on sky",
        number(row.sparta_arcsec, ".2f"),
        number(row.monitor_arcsec, ".2f"),
        f"{1 - row.better:.0%} of the time",
        number(row.wfe_nm, ".0f") + error,
        number(row.wfe_untranslated_nm, ".0f"),
        number(row.wfe_untranslated_nm - row.wfe_nm, ".0f", "nm"),
    )
