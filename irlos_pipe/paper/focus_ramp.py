"""A focus ramp with and without calibrated NCPAs (paper, Fig. "Calibrated LIFT").

The NCPAs of a sample are calibrated from a cube of the narrow H band; the ramp of the same star in J+H
has the same NCPAs and other residuals. Every variant of LIFT sees the same frames.
"""

from typing import Annotated, Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from pydantic import Field

from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.estimate.ramp import summarise
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, RampSizes, calibrated, observe, ramp_scene
from irlos_pipe.paper.common.scenes import FINE
from irlos_pipe.report.drawing import CYCLE, INK, svg
from irlos_pipe.report.text import mode_label

ASKED_NM = 4.0  # requirement on the RMS error of a calibrated ramp
SLOPE_WITHIN = 0.03  # largest deviation of the slope from 1, which tests sign and scale of the ramp
ASKED_OF = ("default_3", "default_9")
CALIBRATED = ("published_3", "published_9", *ASKED_OF)
DRAWN = {
    "none_9": "no NCPAs in the model",
    "published_9": "NCPAs by DIP global",
    "default_9": "this pipeline",
}
COLOURS = (*CYCLE, INK)


class Sizes(RampSizes):
    samples: int = Field(8, ge=1, le=1000, description="sets of NCPAs; the ramp of the first is drawn")
    ways: Annotated[tuple[str, ...], ex.known(LIFT_VARIANTS, "variant")] = Field(
        tuple(LIFT_VARIANTS), min_length=1, description="variants of LIFT"
    )


def samples(ctx: ex.Context) -> ex.Samples:
    return ex.each(ctx, ctx.config.samples, "ramp {index}")


def rows(star: ex.Sample) -> ex.Rows:
    """Simulate cube and ramp, and estimate the ramp by every variant of LIFT."""
    sizes = star.sizes
    cube = star.cube(*sizes.of_cube, sampling=FINE)
    knowledge = calibrated(cube, [LIFT_VARIANTS[key].ncpa for key in sizes.ways])
    observed = observe(ramp_scene(cube, sizes.ramp_mag_j, sizes.introduced_nm), knowledge)
    introduced_nm, true_nm = observed.data.introduced_nm, observed.true_nm
    for key in sizes.ways:
        variant = LIFT_VARIANTS[key]
        fit = observed.estimate(variant)
        modes_nm, converged = observed.modes_nm(variant, fit), fit.result.solution.converged.numpy()
        focus_nm = modes_nm[:, variant.modes.index(DEFOCUS)]
        errors = ramp_errors(introduced_nm, true_nm, fit.defocus_nm, focus_nm)
        drawn = {"introduced_nm": introduced_nm, "true_nm": true_nm, "estimated_nm": modes_nm}
        yield {"key": key, **errors, "converged": float(np.mean(converged)), **drawn}


def ramp_errors(
    introduced_nm: np.ndarray, true_nm: np.ndarray, estimated_nm: np.ndarray, total_nm: np.ndarray
) -> dict[str, float]:
    """Return the errors of one variant on one ramp.

    `true_nm`, (frames, 10), is Noll 2–11 as they were: introduced defocus, NCPAs, and the mean AO residual
    of every frame; `total_nm`, (frames,), the estimated defocus with that of the NCPAs that were given.
    """
    line = summarise(introduced_nm, estimated_nm)
    wrong_nm = total_nm - true_nm[:, DEFOCUS - 2]
    return {
        "slope": line.slope,
        "offset_nm": line.offset_nm,
        "rms_nm": line.rms_nm,
        "line_rms_nm": line.residual_rms_nm,
        "true_rms_nm": float(np.sqrt(np.nanmean(wrong_nm**2))),
    }


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Median and spread over the ramps."""

    def summary(group, key):
        variant = LIFT_VARIANTS[key]
        what = {"label": variant.name, "modes": str(list(variant.modes)), "ncpa": variant.ncpa or None}
        numbers = ("slope", "offset_nm", "rms_nm", "line_rms_nm", "true_rms_nm", "converged")
        return what | {"samples": len(group)} | ex.spreads(group, *numbers)

    return {"ways": ex.grouped(rows, ["key"], summary)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """A calibration mends the ramp, the default's to what is asked."""
    ways = tables["ways"].set_index("key")
    ways["count"] = [len(LIFT_VARIANTS[key].modes) for key in ways.index]
    ways["before_nm"] = [ways.true_rms_nm.get(f"none_{count}") for count in ways["count"]]
    compared, asked = (
        ways.loc[[key for key in keys if key in ways.index]] for keys in (CALIBRATED, ASKED_OF)
    )
    of = "{label}, {count} modes"
    return [
        *ex.checked(
            compared.dropna(subset="before_nm"), f"error with NCPAs over that without, {of}",
            lambda row: row["true_rms_nm"] / row["before_nm"],
            "medians {true_rms_nm:.1f} and {before_nm:.1f} nm RMS", high=1.0,
        ),
        *ex.checked(
            asked, f"defocus error, {of}", "true_rms_nm", "median {true_rms_nm:.1f} nm RMS over the ramps",
            high=ASKED_NM, unit="nm",
        ),
        *ex.checked(
            asked, f"slope, {of}", "slope", "median {slope:.3f}", low=1 - SLOPE_WITHIN, high=1 + SLOPE_WITHIN
        ),
    ]  # fmt: skip


LISTING = ex.Listing("ways", "Variants of LIFT",
    {
        "defocus ramp by LIFT": "{label}", "modes": "{modes}", "slope": "{slope:.3f}",
        "error [nm RMS]": "{true_rms_nm:.1f}", "against the introduced defocus [nm RMS]": "{rms_nm:.1f}",
    },
    caption="Medians over {samples} draws of the NCPAs, against the defocus there was in every exposure; "
    "last column: against the introduced defocus alone, so that the AO residual's own defocus counts as "
    'an error and, without NCPAs, theirs as well; −300…300 nm, J+H, 1 s, m_J 12, 0.35".',
)  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """The first ramp frame by frame."""
    found = {}
    for row in rows[rows["sample"] == rows["sample"].iloc[0]].itertuples():
        for name in ("introduced_nm", "true_nm"):
            found[name] = ex.Quantity(getattr(row, name), "nm", "first ramp; Noll 2–11 as they were")
        text = "first ramp: estimates (frame, mode), given NCPAs included"
        found[f"{row.key}/modes_nm"] = ex.Quantity(row.estimated_nm, "nm", text)
    return found


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """All modes of the first ramp, and the errors of all ramps."""
    keys = [key for key in drawn.tables["ways"].key if key in DRAWN]
    caption = (
        "First ramp, nine modes, median per offset. Dashed: the true wavefront (introduced defocus, NCPAs, "
        "AO residual of each frame). NCPAs given to LIFT count as estimated; tip and tilt are not drawn."
    )
    first = ex.Figure(_first_ramp(drawn, keys), "Estimated modes against introduced defocus", caption, "full")
    rows = drawn.rows()
    rows["named"] = [f"{LIFT_VARIANTS[key].name}, {len(LIFT_VARIANTS[key].modes)}" for key in rows.key]
    errors = ex.strips(
        "focus-ramp-errors", "Error of every ramp",
        "RMS of every ramp against the true and against the introduced defocus. Bars: medians.", rows,
        {"true_rms_nm": "introduced + NCPA + AO residual", "rms_nm": "introduced"},
        by="named", label="error of the defocus [nm RMS]", inches=9, width="full",
    )  # fmt: skip
    return [first, errors] if keys else [errors]


def _first_ramp(drawn: ex.Drawn, keys: list[str]) -> Markup:
    introduced_nm, true_nm = drawn.array("introduced_nm"), drawn.array("true_nm")
    offsets_nm = np.unique(introduced_nm)

    def medians(values: np.ndarray) -> np.ndarray:
        return np.array([np.nanmedian(values[introduced_nm == offset]) for offset in offsets_nm])

    def variant(upper: Axes, lower: Axes, key: str) -> None:
        modes, modes_nm = LIFT_VARIANTS[key].modes, drawn.array(f"{key}/modes_nm")
        for noll, colour in zip((noll for noll in modes if noll not in TIP_TILT), COLOURS, strict=False):
            found, there = medians(modes_nm[:, modes.index(noll)]), medians(true_nm[:, noll - 2])
            upper.plot(offsets_nm, found, "o-", color=colour, markersize=3, label=mode_label(noll))
            upper.plot(offsets_nm, there, "--", color=colour, linewidth=0.9)
            left = medians(modes_nm[:, modes.index(noll)] - true_nm[:, noll - 2])
            lower.plot(offsets_nm, left, "o-", color=colour, markersize=3)
        upper.set_title(DRAWN[key])
        lower.set_xlabel("introduced defocus [nm RMS]")

    def draw(figure: Canvas) -> None:
        shape: Any = {"sharex": True, "sharey": "row", "squeeze": False, "height_ratios": (3, 2)}
        panels = figure.subplots(2, len(keys), **shape)
        for place, key in enumerate(keys):
            variant(panels[0, place], panels[1, place], key)
        panels[0, 0].set_ylabel("coefficient [nm RMS]")
        panels[1, 0].set_ylabel("estimated − true\n[nm RMS]")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    return svg("focus-ramp-modes", (10.5, 6.2), draw)


EXPERIMENT = ex.Experiment(
    "focus_ramp", 8, Sizes, "Focus ramp with and without calibrated NCPAs",
    samples, rows, tables, checks, [LISTING], figures,
    "{samples} ramps in J and H, each with NCPAs of its own, which are unknown or calibrated.",
    "ramps", arrays,
)  # fmt: skip
