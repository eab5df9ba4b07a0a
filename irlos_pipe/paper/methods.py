"""Methods compared on simulated cubes (paper, Fig. "methods"), and what each part of the default contributes.

One sample is one cube with its own NCPAs and its own AO residual. Beside the seeing, the residual's
power spectrum can have another shape than the model of the default assumes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.cube import ObservedCube
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, PAPER_CHOICE, PUBLISHED, VARIANTS
from irlos_pipe.simulate.atmosphere import Shape

MODEL_SHAPE: Shape = "power_law"  # what the model assumes, up to slope and direction
OTHER_SHAPES: tuple[Shape, ...] = ("servo_lag", "aliasing", "non_stationary")
PARTS = tuple(name for name in VARIANTS if name not in PUBLISHED)
METHODS = tuple(METHOD_NAMES)
OVER_FLOOR = 1.3  # asked of the default: its error over what the number of speckles allows
SEVERAL_TIMES = 3.0  # by which a residual in the model has to do better than the paper's choice
DRAWN_NM, DRAWN_SCATTER_NM = 142.0, 30.0  # the paper's NCPAs, Sect. 5.4
STANDARD_ERRORS = 3.0


class Sizes(ex.StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(20, ge=1, le=1000, description="cubes at each of `seeings_arcsec`")
    samples_of_parts: int = Field(
        6, ge=0, le=1000, description="of these, cubes with parts of the default changed"
    )
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), description="seeings with all methods")
    between_arcsec: tuple[float, ...] = Field((0.5, 0.7), description="further seeings of the figure")
    samples_between: int = Field(4, ge=0, le=1000, description="cubes at each of `between_arcsec`")
    shapes: tuple[Shape, ...] = Field(OTHER_SHAPES, description="AO residuals of a shape the model has not")
    samples_of_shapes: int = Field(8, ge=0, le=1000, description="cubes of each shape at each seeing")
    frames: int = Field(300, ge=10, le=10000, description="frames of a cube")
    fractions: tuple[float, ...] = Field(
        (0.25, 0.5), min_length=1, description="parts of a cube, for the speckle floor"
    )
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> Iterator[ex.Sample]:
    """Cubes of all conditions, and the ways each is calibrated; the n-th of every one has the same NCPAs."""
    sizes = ctx.config
    conditions: list[tuple[Shape, float, int, Sequence[str]]] = [
        *((MODEL_SHAPE, seeing, sizes.samples, METHODS) for seeing in sizes.seeings_arcsec),
        *((MODEL_SHAPE, seeing, sizes.samples_between, METHODS) for seeing in sizes.between_arcsec),
        *(
            (shape, seeing, sizes.samples_of_shapes, (DEFAULT, PAPER_CHOICE))
            for shape in sizes.shapes
            for seeing in sizes.seeings_arcsec
        ),
    ]
    for place, (shape, seeing, count, variants) in enumerate(conditions):
        for index in range(count):
            dissected = place < len(sizes.seeings_arcsec) and index < sizes.samples_of_parts
            tried = (*PARTS, *PUBLISHED) if dissected else variants
            of = {"shape": shape, "seeing_arcsec": seeing, "dissected": dissected, "variants": tried}
            yield ex.sample(ctx, f"{shape}, {seeing:g} arcsec, cube {index}", index, **of)


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate a cube in every way, and parts of it by the default."""
    cube = ObservedCube.of(
        star.cube(star["seeing_arcsec"], star.sizes.frames, star.sizes.mag_j, star["shape"])
    )
    for name in star["variants"]:
        calibration = cube.calibrated(VARIANTS[name])
        yield {
            "variant": name,
            "part": 1.0,
            "introduced_nm": cube.introduced_wfe_nm(),
            "modes_nm": cube.modes_delta_nm(calibration),
            "pupil_nm": cube.pupil_delta_nm(calibration),
            "chi2_nu": calibration.chi2_nu,
        }
    for part in star.sizes.fractions if star["dissected"] else ():
        fewer = cube.first(max(2, round(part * len(cube.frames.images_e))))
        error_nm = fewer.modes_delta_nm(fewer.calibrated(VARIANTS[DEFAULT]))
        yield {"variant": DEFAULT, "part": part, "modes_nm": error_nm}


def speckle_floor_nm(errors_nm: Mapping[float, Sequence[float]]) -> tuple[float, float]:
    """Split the default's error into a part that falls with the number of frames and the rest.

    ``error² = floor² / part + rest²``, least squares over the mean squares at every part of the cube.

    Parameters
    ----------
    errors_nm : mapping
        Errors over samples by the part of the cube that was used, 1 for the whole cube.

    Returns
    -------
    floor_nm, rest_nm : float
        Error from the finite number of speckles in the whole cube; error of an endless cube.
    """
    parts = np.array(sorted(errors_nm))
    squares = np.array([np.mean(np.square(errors_nm[part])) for part in parts])
    # The mean squares have similar relative errors, so every equation is divided by its own square.
    design = np.stack([1 / parts, np.ones(len(parts))], axis=1) / squares[:, None]
    noise, rest = np.maximum(np.linalg.lstsq(design, np.ones(len(parts)), rcond=None)[0], 0)
    return float(np.sqrt(noise)), float(np.sqrt(rest))


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Conditions; all methods under each; the parts of the default, on the cubes where all were changed."""
    condition, whole = ["shape", "seeing_arcsec"], rows[rows.part == 1]

    def summary(group: ex.Frame) -> dict[str, Any]:
        cubes = group[group.part == 1].drop_duplicates("sample")
        median_nm = {name: _median(group, name) for name in (DEFAULT, PAPER_CHOICE)}
        numbers = {
            "samples": len(cubes),
            "introduced_nm": np.mean(cubes.introduced_nm.to_numpy()),
            "introduced_scatter_nm": np.std(cubes.introduced_nm.to_numpy()),
            "ratio_to_dip_global": median_nm[DEFAULT] / median_nm[PAPER_CHOICE],
            **{f"{name}_nm": value for name, value in median_nm.items()},
        }
        by_part = group[group.dissected & (group.variant == DEFAULT)].groupby("part").modes_nm
        floor = (
            speckle_floor_nm({part: values.to_numpy() for part, values in by_part}) if len(by_part) else ()
        )
        names = ("speckle_floor_nm", "beside_floor_nm", "default_of_parts_nm", "samples_of_parts")
        of_parts = group[group.dissected & (group.variant == DEFAULT) & (group.part == 1)].modes_nm
        own = (*floor, np.median(of_parts), len(of_parts)) if floor else [None] * 4
        return numbers | dict(zip(names, own, strict=True))

    def errors(group: ex.Frame) -> dict[str, Any]:
        name = group.variant.iloc[0]
        found: dict[str, Any] = {
            "label": VARIANTS[name].label,
            "method": METHOD_NAMES.get(name),
            "samples": len(group),
        }
        for name in ("modes_nm", "pupil_nm"):
            found |= ex.spreads(group, name) | ex.median_in_range(name, group[name])
            found[f"{name}_worst"] = group[name].max()
        return found | {"chi2_nu": np.median(group.chi2_nu)}

    of_all = whole[whole.variant.isin(METHODS)].sort_values("variant", key=_places, kind="stable")
    of_parts = whole[whole.dissected & whole.variant.isin(PARTS)]
    shown = {
        "conditions": ex.grouped(rows, condition, summary),
        "methods": ex.grouped(of_all, [*condition, "variant"], errors),
        "parts": ex.grouped(of_parts, [*condition, "variant"], errors),
    }
    return {name: table for name, table in shown.items() if len(table)}


def _places(variants: ex.Frame) -> ex.Frame:
    return variants.map(METHODS.index)


def _median(group: ex.Frame, variant: str) -> float:
    return float(np.median(group.modes_nm[(group.variant == variant) & (group.part == 1)]))


def checks(tables: ex.Tables) -> list[ex.Check]:
    """NCPAs as in the paper, the default near its floor and well before the paper's choice."""
    introduced, floors, ratios = [], [], []
    for row in tables["conditions"].itertuples():
        of = f"{row.shape}, {row.seeing_arcsec:g} arcsec"
        reach_nm = STANDARD_ERRORS * DRAWN_SCATTER_NM / math.sqrt(row.samples)
        text = f"{row.introduced_nm:.0f} nm in the mean of {row.samples} cubes, {DRAWN_NM:g} in the paper"
        limits = DRAWN_NM - reach_nm, DRAWN_NM + reach_nm
        introduced.append(ex.Check(f"introduced NCPAs, {of}", row.introduced_nm, "nm", *limits, text))
        floor_nm, own_nm = row.speckle_floor_nm, row.default_of_parts_nm
        if math.isfinite(floor_nm):
            over = own_nm / floor_nm if floor_nm > 0 else math.inf
            text = f"median {own_nm:.1f} nm of {row.samples_of_parts:g} cubes, floor {floor_nm:.1f} nm"
            floors.append(ex.at_most(f"default over the floor of the speckles, {of}", over, OVER_FLOOR, text))
        text = f"medians {row.long_exposure_nm:.1f} and {row.dip_global_nm:.1f} nm"
        name = f"default over DIP global, {of}"
        ratios.append(ex.at_most(name, row.ratio_to_dip_global, 1 / SEVERAL_TIMES, text))
    return [*introduced, *floors, *ratios]


MODES, PUPIL = "{modes_nm:.1f} ({modes_nm_low:.1f}–{modes_nm_high:.1f})", "{pupil_nm:.1f}"
LISTINGS = [
    ex.Listing("methods", "Δ-WFE of every method",
        {"method": "{method}"},
        {'{seeing_arcsec}", 29 modes [nm]': MODES, '{seeing_arcsec}", full pupil': PUPIL},
        caption="Median Δ-WFE and, in brackets, where it lies with 90 % (bootstrap over the cubes), over "
        "{samples} cubes at each seeing.",
        where=f"shape == '{MODEL_SHAPE}' and seeing_arcsec in [0.35, 1.0]", page="methods",
    ),
    ex.Listing("conditions", "Other AO residuals",
        {
            "AO residual": "{shape}", 'seeing ["]': "{seeing_arcsec}",
            "this pipeline [nm]": f"{{{DEFAULT}_nm:.1f}}", "DIP global [nm]": f"{{{PAPER_CHOICE}_nm:.1f}}",
            "ratio": "{ratio_to_dip_global:.2f}", "cubes": "{samples}",
            "speckle floor [nm]": "{speckle_floor_nm:.1f}", "beside it": "{beside_floor_nm:.1f}",
        },
        caption="Median Δ-WFE in Noll 2–30, also where the residual's power spectrum is not of the "
        "modelled family. Speckle floor: the part of the default's error that falls as 1/√frames.",
        page="residual_shapes",
    ),
    ex.Listing("parts", "What each part of the default contributes",
        {"calibration": "{label}"},
        {'{seeing_arcsec}" [nm]': "{modes_nm:.1f}", '{seeing_arcsec}", χ²/ν': "{chi2_nu:.2f}"},
        caption="Median Δ-WFE in Noll 2–30 with one part of the default changed, over {samples} cubes at "
        "each seeing.",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Error against seeing, and all cubes of the seeings at which parts were changed."""
    modelled = (
        drawn.tables["methods"].query(f"shape == '{MODEL_SHAPE}'").sort_values("seeing_arcsec", kind="stable")
    )
    labels, caption = ('seeing ["]', "Δ-WFE in Noll 2–30 [nm RMS]"), "Medians; bars: 16th to 84th percentile."
    seeing = ex.lines(
        "methods-seeing",
        modelled,
        "seeing_arcsec",
        "modes_nm",
        colour="method",
        labels=labels,
        ends=("p16", "p84"),
    )
    rows = drawn.rows().query(f"shape == '{MODEL_SHAPE}' and part == 1")
    rows = rows[rows.variant.isin(METHODS)].sort_values("seeing_arcsec", kind="stable")
    rows["named"] = rows.seeing_arcsec.map("{:g}″, ".format) + rows.variant.map(METHOD_NAMES)
    cubes = ex.strips("methods-samples", rows, {"modes_nm": "Noll 2–30"}, by="named", label=labels[1])
    return [
        ex.Figure(seeing, "Error against seeing", caption),
        ex.Figure(cubes, "Distribution over cubes", "Every point is a cube with NCPAs of its own."),
    ]


EXPERIMENT = ex.Experiment(
    "methods", 7, Sizes, "Calibration methods",
    samples, rows, tables, checks, LISTINGS, figures,
    "NCPAs of {introduced_nm:.0f} ± {introduced_scatter_nm:.0f} nm RMS; published methods have 29 modes.",
    "cubes",
)  # fmt: skip
