"""The seeing scales of SPARTA and of a seeing monitor, and what their difference means for the AO residual.

The monitor's seeing is log-normal; SPARTA's follows from it by a linear relation and a log-normal
scatter, as the two look at different air. Of the paper's figure only the tendency is known.
"""

from dataclasses import asdict
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure as Canvas
from pydantic import Field

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.laws import SPARTA, ResidualLaw, SeeingScale
from irlos_pipe.paper import experiment as ex
from irlos_pipe.report.drawing import BLUE, FAINT, INK, ORANGE, svg

WITHIN = 0.02  # of 1, for the ratio of medians: some six standard errors of 20 000 draws
RANKS = {"median": 50.0, "p16": 16.0, "p84": 84.0}  # percentiles of the distributions
SIZE_IN = (4.4, 3.2)

Seeing = Annotated[float, Field(gt=0, le=10)]

LISTING = ex.Listing("conditions", "The paper's conditions",
    {
        "condition": "{where}", 'SPARTA ["]': "{sparta_arcsec:.2f}", 'monitor ["]': "{monitor_arcsec:.2f}",
        "better by SPARTA": "{better:.0%} of the time",
        "AO residual [nm RMS]": "{wfe_nm:.0f} ± {wfe_sigma_nm:.0f}",
        "if not translated": "{wfe_untranslated_nm:.0f}",
    },
    caption="Errors: 1σ of the disagreement between the two, where only the monitor's seeing is known.",
)  # fmt: skip


class Sizes(ex.StageConfig):
    """The relation and the statistics."""

    monitor: str = Field("mass_dimm", description="seeing monitor, by its name in the instrument profile")
    ratio: float | None = Field(None, gt=0, le=10, description="SPARTA over monitor; null: the profile's")
    offset_arcsec: float | None = Field(None, ge=-1, le=1, description="added then; null: the profile's")
    median_arcsec: Seeing = Field(0.7, description="median of the monitor's seeing; assumed")
    scatter: float = Field(0.35, gt=0, le=2, description="standard deviation of its logarithm; assumed")
    disagreement: float = Field(0.15, ge=0, le=2, description="of the logarithm about the relation; assumed")
    draws: int = Field(20000, ge=100, le=10_000_000, description="simultaneous measurements drawn")
    simulated_arcsec: tuple[Seeing, ...] = Field((0.35, 1.0), description="of the simulations, by SPARTA")
    on_sky_arcsec: tuple[Seeing, ...] = Field((0.5, 1.2, 1.5), description="of the sky tests, by the monitor")


def samples(ctx: ex.Context) -> ex.Samples:
    """All draws together; SPARTA's scale from the monitor's by the profile, changed as the recipe says."""
    yield ex.sample(ctx, "draws", scale=scale_of(ctx))


def scale_of(ctx: ex.Context) -> SeeingScale:
    """Return the relation of the two."""
    sizes, known = ctx.config, ctx.instrument.seeing_scales
    monitors = sorted(known.keys() - {SPARTA})
    if sizes.monitor not in monitors:
        raise ConfigurationError(
            f"seeing_scales.monitor = '{sizes.monitor}': no such monitor in the "
            f"instrument profile; known: {', '.join(monitors) or 'none'}"
        )
    given = {"ratio": sizes.ratio, "offset_arcsec": sizes.offset_arcsec}
    changes = {key: value for key, value in given.items() if value is not None}
    return SeeingScale(**asdict(known[sizes.monitor]) | changes)


def rows(seeing: ex.Sample) -> ex.Rows:
    """Draw the seeing by both at the same time."""
    rng, sizes, scale = np.random.default_rng(seeing.seed[0]), seeing.sizes, seeing["scale"]
    monitor_arcsec = sizes.median_arcsec * np.exp(sizes.scatter * rng.standard_normal(sizes.draws))
    disagreement = np.exp(sizes.disagreement * rng.standard_normal(sizes.draws))
    sparta_arcsec = scale.to_sparta(monitor_arcsec) * disagreement
    if np.any(sparta_arcsec <= 0):
        raise ConfigurationError(
            f"seeing_scales.offset_arcsec = {scale.offset_arcsec:g}: makes good seeing "
            "negative on SPARTA's scale; raise it"
        )
    yield {"monitor_arcsec": monitor_arcsec, "sparta_arcsec": sparta_arcsec}


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """The paper's conditions on both scales, the distributions, and the relation with its source."""
    sizes, scale, law = ctx.config, scale_of(ctx), ctx.instrument.facility.residual_law
    monitor, sparta = rows.monitor_arcsec.iloc[0], rows.sparta_arcsec.iloc[0]

    def condition(where, sparta_arcsec):
        monitor_arcsec = (sparta_arcsec - scale.offset_arcsec) / scale.ratio
        return {
            "where": where,
            "sparta_arcsec": sparta_arcsec,
            "monitor_arcsec": monitor_arcsec,
            "better": float(np.mean(sparta < sparta_arcsec)),  # part of the time by SPARTA
            "wfe_nm": law.wfe_nm(sparta_arcsec),
            "wfe_sigma_nm": law.nm_per_arcsec * sparta_arcsec * sizes.disagreement,
            "wfe_untranslated_nm": law.wfe_nm(monitor_arcsec),
        }

    def distribution(quantity, values):
        ranks = {name: float(np.percentile(values, rank)) for name, rank in RANKS.items()}
        return {"quantity": quantity, **ranks, "draws": len(values)}

    source = {"status": "given", "source": "recipe"}
    if sizes.ratio is None:
        fact = ctx.instrument.facts[ctx.instrument.profile.seeing_scales[sizes.monitor].ratio][-1]
        source = {"status": fact.status, "source": fact.source}
    quantities = {"monitor_arcsec": monitor, "sparta_arcsec": sparta}
    quantities |= {"wfe_nm": law.wfe_nm(sparta), "wfe_untranslated_nm": law.wfe_nm(monitor)}
    of_law = {f"residual_law_{name}": value for name, value in asdict(law).items()}
    return {
        "relation": ex.frame([{"monitor": sizes.monitor, **asdict(scale), **source, **of_law}]),
        "conditions": ex.frame(
            [condition("simulation", one) for one in sizes.simulated_arcsec]
            + [condition("sky", scale.to_sparta(one)) for one in sizes.on_sky_arcsec]
        ),
        "distributions": ex.frame(distribution(*one) for one in quantities.items()),
    }


def checks(tables: ex.Tables) -> list[ex.Check]:
    """SPARTA's seeing is, in the median, that of the relation."""
    relation, median = tables["relation"].iloc[0], tables["distributions"].set_index("quantity")["median"]
    expected_arcsec = SeeingScale(relation.ratio, relation.offset_arcsec).to_sparta(median["monitor_arcsec"])
    sparta_arcsec = median["sparta_arcsec"]
    text = f"{sparta_arcsec:.3f} and {expected_arcsec:.3f} arcsec"
    name, ratio = "SPARTA's median seeing over that of the relation", sparta_arcsec / expected_arcsec
    return [ex.check(name, ratio, text, low=1 - WITHIN, high=1 + WITHIN)]


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    names = ("monitor_arcsec", "sparta_arcsec")
    return {f"draws/{name}": ex.Quantity(rows[name].iloc[0], "arcsec", "drawn seeing") for name in names}


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """How often each sees what, the mapping of one scale to the other, and the AO residual."""
    relation, conditions, sizes = drawn.tables["relation"].iloc[0], drawn.tables["conditions"], drawn.sizes
    scale = SeeingScale(relation.ratio, relation.offset_arcsec)
    law = ResidualLaw(*(relation[name] for name in relation.index if name.startswith("residual_law_")))
    monitor = np.linspace(0.2, 1.1 * max([*conditions.monitor_arcsec, 2.0]), 100)
    sparta, factor = scale.to_sparta(monitor), np.exp(sizes["disagreement"])
    label = f'{relation.monitor} ["]'

    def distributions(figure: Canvas) -> None:
        axes = figure.subplots()
        draws = {name: drawn.array(f"draws/{name}_arcsec") for name in ("monitor", "sparta")}
        edges = np.linspace(0, np.percentile(draws["monitor"], 99.5), 60)
        for (name, values), ink in zip(draws.items(), (ORANGE, BLUE), strict=True):
            axes.hist(values, edges.tolist(), density=True, color=ink, alpha=0.35, label=name)
            axes.axvline(np.median(values), color=ink)
        middle = (edges[1:] + edges[:-1]) / 2
        deviation = np.log(middle / sizes["median_arcsec"]) / sizes["scatter"]
        log_normal = np.exp(-(deviation**2) / 2) / (middle * sizes["scatter"] * np.sqrt(2 * np.pi))
        axes.plot(middle, log_normal, color=ORANGE)
        axes.set(xlabel='seeing ["]', ylabel='probability density [1/"]')
        axes.legend()

    def mapping(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(monitor, monitor, color=FAINT)
        axes.fill_between(monitor, sparta / factor, sparta * factor, color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(monitor, sparta, color=BLUE)
        axes.plot(conditions.monitor_arcsec, conditions.sparta_arcsec, "o", color=INK)
        axes.set(xlabel=label, ylabel='SPARTA ["]')

    def residual(figure: Canvas) -> None:
        axes = figure.subplots()
        band = (law.wfe_nm(sparta / factor), law.wfe_nm(sparta * factor))
        axes.fill_between(monitor, *band, color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(monitor, law.wfe_nm(sparta), color=BLUE, label="translated")
        axes.plot(monitor, law.wfe_nm(monitor), color=ORANGE, label="taken as it is")
        axes.set(xlabel=label, ylabel="AO residual [nm RMS]")
        axes.legend()

    shown = {
        "How often each sees what":
            (distributions, "Line: the distribution from which the monitor's are drawn."),
        "From one scale to the other":
            (mapping, "Line: relation, band: 1σ of the disagreement, grey: equal scales."),
        "What it means for the AO residual": (residual, "The residual's law is stated for SPARTA's seeing."),
    }  # fmt: skip
    return [
        ex.Figure(svg(f"seeing-{draw.__name__}", SIZE_IN, draw), title, caption, "third")
        for title, (draw, caption) in shown.items()
    ]


EXPERIMENT = ex.Experiment(
    "seeing_scales", 4, Sizes, "Seeing by SPARTA and by a seeing monitor",
    samples, rows, tables, checks, [LISTING], figures,
    "SPARTA = {ratio:.2f} · {monitor} {offset_arcsec:+.2f} arcsec ({status}: {source}).", "draws", arrays,
)  # fmt: skip
