"""Section on what the model lacked: verdict, names, images before and after, what is left, limits."""

from __future__ import annotations

from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Text
from irlos_pipe.report.drawing import BLUE, FAINT, ORANGE, svg
from irlos_pipe.report.effect_words import sizes
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose_images import curve_figures, picture_blocks, pupil_figures
from irlos_pipe.report.section_diagnose_names import (
    candidate_tables,
    ranking_figures,
    separation_tables,
    step_tables,
)
from irlos_pipe.report.section_diagnose_ramp import ramp_figures
from irlos_pipe.report.section_diagnose_rest import rest_blocks
from irlos_pipe.report.section_diagnose_sharing import sharing_tables
from irlos_pipe.report.section_diagnose_verdict import tried_tables, verdict_table
from irlos_pipe.report.text import is_known, number, plural, with_error
from irlos_pipe.stages.diagnose.results import DiagnoseResults, GapRow

STAGE = "diagnose"
FINE = (
    "Structure finer than λ/D, which no light through the pupil can make: {ratio} times what noise leaves "
    "there ({sigma} σ). More comes from the pixels: flat, offsets, response."
)
OF_FRAMES = "Σ|measured − predicted| / Σ measured of data that no fit has seen{shrink}."
OF_RAMP = (
    "Σ|measured − predicted| / Σ measured of frames that no fit has seen. Noise alone is estimated from the "
    "scatter of all frames of an offset, image motion included, which is refitted: it is an upper limit."
)
GAP_IN = (3.9, 1.9)
LIMITS = "Effects that were not seen: above these sizes they would have been."


def diagnose_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(DiagnoseResults)
    ramp, gap = ramp_figures(run), gap_figures(results)
    first: list[Block] = [*verdict_table(results), *step_tables(results), *candidate_tables(results)]
    blocks: list[Block] = [
        *([*ramp, Stack([*first, *gap])] if ramp else first),
        *picture_blocks(run),
        *rest_blocks(run, results),
        *pupil_figures(run, results),
        *([] if ramp else gap),
        *ranking_figures(results),
        *curve_figures(run),
        *sharing_tables(results),
        *separation_tables(results),
        *tried_tables(results),
        *_modes(results),
        *_limits(results),
    ]
    return Section(STAGE, f"What the {'ramp' if ramp else 'model'} lacks", _lead(results), blocks)


def _lead(results: DiagnoseResults) -> str:
    frames = results.frames
    if results.held_out == "pixels":
        return (
            f"{plural(frames.training, 'frame')} fitted, some of their pixels held out to judge the models."
        )
    if frames.training:
        return f"{plural(frames.training, 'frame')} fitted, {frames.held_out} held out to judge the models."
    return ""


# -- numbers -----------------------------------------------------------------------------------


def gap_figures(results: DiagnoseResults) -> list[Figure]:
    """Return the gap before and after beside that of noise alone, if it is known."""
    gap = results.gap
    if not is_known(gap.before):
        return []
    shrink = (
        f"; {number(gap.shrink, '.0%')} of what noise does not explain is closed"
        if is_known(gap.shrink)
        else ""
    )
    caption = OF_FRAMES.format(shrink=shrink) if results.grade else OF_RAMP
    return [Figure(gap_bars("dia-gap", gap), "Gap to unseen data", caption, "third")]


def _modes(results: DiagnoseResults) -> list[Table]:
    before, after, sigma = results.zernike_nm.before, results.zernike_nm.after, results.sigma_nm
    both = [noll for noll in after if noll in before]
    rows = [
        (str(noll), number(before[noll], "+.1f"), with_error(after[noll], sigma.get(noll), "+.1f"))
        for noll in both
    ]
    if not any(abs(after[noll] - before[noll]) > 1e-6 for noll in both):
        return []
    columns = ("Noll", "before [nm]", "after [nm]")
    return [Table(columns, rows, "NCPAs with the old and with the new model", folded=True)]


def _limits(results: DiagnoseResults) -> list[Table | Text | Stack]:
    rows = [(name, sizes(public)) for name, public in results.mdb.items()]
    table = Table(
        ("effect", "smallest size that would have been seen"), rows, "Not seen", LIMITS, folded=True
    )
    hidden = [(name, *_second(results, name)) for name in results.untestable]
    columns = ("effect", "second recording that shows it", "smallest size seen then")
    untestable = Table(
        columns, hidden, "Not to be seen in these data: the free parameters imitate it", folded=True
    )
    texts = [Text(f"Noise: {results.noise.text}.")] if results.noise else []
    if results.fine_structure:
        ratio = number(results.fine_structure.ratio, ".2f")
        sigma = number(results.fine_structure.significance, ".1f")
        texts.append(Text(FINE.format(ratio=ratio, sigma=sigma)))
    return [*([table] if rows else []), *([untestable] if hidden else []), *texts]


def _second(results: DiagnoseResults, name: str) -> tuple[str, str]:
    """The recording to take, and what it would show."""
    advice = results.second_recording.get(name)
    if advice is None:
        return "none of those tried", "–"
    return advice.recording, sizes(advice.smallest)


# -- drawings ----------------------------------------------------------------------------------


def gap_bars(name: str, gap: GapRow) -> Markup:
    """Draw the `gap` before and after above that of noise alone; `name` is unique in the page."""
    rows = {"before": (gap.before, ORANGE), "after": (gap.after, BLUE), "noise alone": (gap.floor, FAINT)}

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        values = [value for value, _ in rows.values()]
        bars = axes.barh(list(rows), values, 0.7, color=[colour for _, colour in rows.values()])
        axes.bar_label(bars, [number(100 * value, ".2f", "%") for value in values], padding=3, fontsize=8)
        axes.set(xlabel="gap, part of the light", ylim=(2.5, -0.5))
        axes.margins(x=0.2)
        axes.grid(axis="y", visible=False)

    return svg(name, GAP_IN, draw)
