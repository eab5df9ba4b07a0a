"""All calibration methods on the same cubes, with the same modes and the same frames (paper, Sect. 5).

Published methods have 29 modes and the default an open basis; here every method has every number of modes.
Starts are those of the stage `calibrate`: none knows more than the diversity. The default has the law that
the NCPAs are drawn from as prior, which makes no difference at m_J 7 (`methods`, without prior).
"""

from dataclasses import replace

import numpy as np
from pydantic import Field

from irlos_pipe.estimate.calibration_options import OPEN
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, VARIANTS, ObservedCube
from irlos_pipe.simulate.scene import Scene, draw_tail_nm

TAIL_STREAM = 3  # child of the cube's seed that the tail is drawn from
LAST_TAIL_NOLL = 200
OWN = "own modes"

RANGE = "{error_nm:.1f} ({error_nm_low:.1f}–{error_nm_high:.1f})"


class Sizes(ex.StageConfig):
    samples: int = Field(20, ge=1, le=1000, description="cubes at each seeing, without a tail")
    samples_of_tails: int = Field(6, ge=0, le=1000, description="cubes at each seeing with each tail")
    samples_of_parts: int = Field(6, ge=0, le=1000, description="of those without, tried with fewer frames")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), min_length=1, description="on SPARTA's scale")
    tails_nm: tuple[float, ...] = Field(
        (1.0, 3.0, 10.0), description="RMS of every mode from Noll 52 to 200 [nm]"
    )
    highest_nolls: tuple[int, ...] = Field(
        (30, 51, 66), min_length=1, description="last fitted Noll mode of every method, 30 at least"
    )
    frames: int = Field(300, ge=10, le=10000, description="frames of a cube")
    parts: tuple[int, ...] = Field((10, 30, 100, 200), description="numbers of frames that are tried")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> ex.Samples:
    """Cubes without a tail, then with each; the n-th of every condition has the same NCPAs but for it."""
    sizes = ctx.config
    for seeing in sizes.seeings_arcsec:
        for tail_nm in (0.0, *sizes.tails_nm):
            for index in range(sizes.samples_of_tails if tail_nm else sizes.samples):
                parts = sizes.parts if not tail_nm and index < sizes.samples_of_parts else ()
                name = f"{seeing:g} arcsec, tail {tail_nm:g} nm, cube {index}"
                yield ex.sample(ctx, name, index, seeing_arcsec=seeing, tail_nm=tail_nm, parts=parts)


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate a cube by every method with every number of modes, and its first frames with its own."""
    scene = with_tail(star.cube(star["seeing_arcsec"], star.sizes.frames, star.sizes.mag_j), star["tail_nm"])
    cube = ObservedCube.of(scene)
    introduced_nm = float(np.linalg.norm(list(scene.ncpa_nm.values())))
    for method in METHOD_NAMES:
        variant = VARIANTS[method]
        tried = [
            (f"{last - 1} modes", variant.with_modes(last), scene.frames) for last in star.sizes.highest_nolls
        ]
        if method == DEFAULT:
            tried.append((OPEN, variant.with_modes(OPEN), scene.frames))
        for fitted, own, frames in [*tried, *((OWN, variant, count) for count in star["parts"])]:
            error_nm = cube.first(frames).error_nm(own)
            found = {"frames": frames, "error_nm": error_nm, "introduced_nm": introduced_nm}
            yield {"method": method, "fitted": fitted, **found}


def with_tail(scene: Scene, tail_nm: float) -> Scene:
    """Return a `scene` with `tail_nm` RMS in every mode from behind the last of its NCPAs to Noll 200."""
    if not tail_nm:
        return scene
    rng = np.random.default_rng((*scene.seed, TAIL_STREAM))
    drawn_nm = draw_tail_nm(rng, tail_nm, max(scene.ncpa_nm) + 1, LAST_TAIL_NOLL)
    return replace(scene, ncpa_nm={**scene.ncpa_nm, **drawn_nm})


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Medians over the cubes of a condition, with their range."""
    drawn_nm = rows[rows.tail_nm == 0].drop_duplicates("sample").introduced_nm.to_numpy()
    of_all = {"introduced_nm": np.mean(drawn_nm), "introduced_scatter_nm": np.std(drawn_nm)}

    def errors(group, seeing_arcsec, tail_nm, method, *_):
        label = {"label": METHOD_NAMES[method], "cubes": len(group)}
        return label | ex.median_in_range("error_nm", group.error_nm) | of_all

    return {"methods": ex.grouped(rows, ["seeing_arcsec", "tail_nm", "method", "fitted", "frames"], errors)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default against the best of the others with any modes."""

    def best(group, *_):
        others = group[group.method != DEFAULT]
        other = others.loc[others.error_nm.idxmin()]
        own_nm = group[group.method == DEFAULT].error_nm.iloc[-1]
        return {"own_nm": own_nm, "label": other.label, "other_nm": other.error_nm}

    table = tables["methods"]
    return ex.checked(
        ex.grouped(table[table.fitted != OWN], ["seeing_arcsec", "tail_nm"], best),
        "default over the best of the others, {seeing_arcsec:g} arcsec, tail {tail_nm:g} nm",
        lambda row: row["own_nm"] / row["other_nm"],
        "medians {own_nm:.1f} nm, {label} {other_nm:.1f} nm", high=1.0,
    )  # fmt: skip


LISTINGS = [
    ex.Listing("methods", "Modes",
        {"method": "{label}"},
        {'{seeing_arcsec}", {fitted}': RANGE},
        caption="Error in Noll 2–30 [nm RMS], medians over {cubes} cubes of {frames} frames at each "
        "seeing, ranges of 90 % by bootstrap over cubes; NCPAs {introduced_nm:.0f} ± "
        "{introduced_scatter_nm:.0f} nm RMS.",
        where=f"tail_nm == 0 and fitted != '{OWN}'",
    ),
    ex.Listing("methods", "Modes beyond those that are fitted",
        {'seeing ["]': "{seeing_arcsec}", "tail per mode [nm]": "{tail_nm:.0f}", "cubes": "{cubes}"},
        {"{label}, {fitted}": RANGE},
        heads=(
            f"{METHOD_NAMES[DEFAULT]}, open", f"{METHOD_NAMES[DEFAULT]}, 65 modes", "LIFT slices, 29 modes",
            "LIFT slices, 50 modes", "DIP global, 29 modes", "DIP global, 50 modes",
        ),
        where="tail_nm > 0", caption="The same, with further modes from Noll 52 to 200.",
    ),
    ex.Listing("methods", "Frames",
        {"method": "{label}"},
        {'{seeing_arcsec}", {frames} frames': "{error_nm:.1f}"},
        caption="The same without a tail by the number of frames, with the modes that each method has by "
        "itself, against the wavefront averaged over these frames; {cubes} cubes at each seeing.",
        where=f"fitted == '{OWN}'",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Error against modes, without a tail."""
    return [ex.lines(
        "ranking", "Error against modes", "Without a tail, by the seeing [arcsec].",
        drawn.tables["methods"].query(f"tail_nm == 0 and fitted != '{OWN}'"), "fitted", "error_nm",
        colour="label", panels="seeing_arcsec", ends=("low", "high"),
        labels=("fitted", "error in Noll 2–30 [nm]"), size=(9.0, 4.4), width="full",
    )]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "ranking", 4, Sizes, "All methods with the same modes and frames",
    samples, rows, tables, checks, LISTINGS, figures,
    "NCPAs as drawn {introduced_nm:.0f} ± {introduced_scatter_nm:.0f} nm RMS, and tails where named.",
    "cubes",
)  # fmt: skip
