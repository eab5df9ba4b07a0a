"""Methods compared on simulated cubes (paper, Fig. "methods"), and what each part of the default contributes.

One sample is one cube with its own NCPAs and its own AO residual. Beside the seeing, the residual's
power spectrum can have another shape than the model of the default assumes.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import calibrations
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, PAPER_CHOICE, VARIANTS, ObservedCube
from irlos_pipe.simulate.atmosphere import Shape

MODEL_SHAPE: Shape = "power_law"  # what the model assumes, up to slope and direction
OTHER_SHAPES: tuple[Shape, ...] = ("servo_lag", "aliasing", "non_stationary")
PARTS = tuple(name for name in VARIANTS if name not in calibrations.PUBLISHED)
METHODS = tuple(METHOD_NAMES)
OVER_FLOOR = 1.3  # requirement on the default's error over what the number of speckles allows
SEVERAL_TIMES = 3.0  # factor by which a model with AO residual has to be better than the paper's choice
DRAWN_NM, DRAWN_SCATTER_NM = 142.0, 30.0  # the paper's NCPAs, Sect. 5.4
STANDARD_ERRORS = 3.0

MODES, PUPIL = "{modes_nm:.1f} ({modes_nm_low:.1f}–{modes_nm_high:.1f})", "{pupil_nm:.1f}"


class Sizes(ex.StageConfig):
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


def samples(ctx: ex.Context) -> ex.Samples:
    """Cubes of all conditions, and the ways each is calibrated; the n-th of every one has the same NCPAs."""
    sizes = ctx.config
    main, others = sizes.seeings_arcsec, (DEFAULT, PAPER_CHOICE)
    for place, (shape, seeings, count, variants) in enumerate(
        (
            (MODEL_SHAPE, main, sizes.samples, METHODS),
            (MODEL_SHAPE, sizes.between_arcsec, sizes.samples_between, METHODS),
            *((shape, main, sizes.samples_of_shapes, others) for shape in sizes.shapes),
        )
    ):
        for seeing in seeings:
            for index in range(count):
                dissected = not place and index < sizes.samples_of_parts
                tried = (*PARTS, *calibrations.PUBLISHED) if dissected else variants
                of = {"shape": shape, "seeing_arcsec": seeing, "dissected": dissected, "variants": tried}
                yield ex.sample(ctx, f"{shape}, {seeing:g} arcsec, cube {index}", index, **of)  # fmt: skip


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate a cube in every way, and parts of it by the default."""
    sizes = star.sizes
    cube = ObservedCube.of(star.cube(star["seeing_arcsec"], sizes.frames, sizes.mag_j, star["shape"]))
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
    for part in sizes.fractions if star["dissected"] else ():
        fewer = cube.first(max(2, round(part * len(cube.frames.images_e))))
        yield {"variant": DEFAULT, "part": part, "modes_nm": fewer.error_nm(VARIANTS[DEFAULT])}


def speckle_floor_nm(errors_nm: Mapping[float, Sequence[float]]) -> tuple[float, float]:
    """Split the default's error into a part that falls with the number of frames and the rest.

    ``error² = floor² / part + rest²``, least squares over the mean squares at every part of the cube.
    `errors_nm` are those over samples by the part of the cube that was used, 1 for the whole cube. Returns
    the error from the finite number of speckles in the whole cube, and that of an endless cube [nm].
    """
    parts = np.array(sorted(errors_nm))
    squares = np.array([np.mean(np.square(errors_nm[part])) for part in parts])
    # The mean squares have similar relative errors, so every equation is divided by its own square.
    design = np.stack([1 / parts, np.ones(len(parts))], axis=1) / squares[:, None]
    noise, rest = np.maximum(np.linalg.lstsq(design, np.ones(len(parts)), rcond=None)[0], 0)
    return float(np.sqrt(noise)), float(np.sqrt(rest))


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Conditions; all methods under each; the parts of the default, on the cubes where all were changed."""
    by, whole = ["shape", "seeing_arcsec"], rows[rows.part == 1]

    def condition(group, *_):
        all_of_it = group[group.part == 1]
        introduced_nm = all_of_it.drop_duplicates("sample").introduced_nm.to_numpy()
        own_nm, other_nm = (
            float(np.median(all_of_it.modes_nm[all_of_it.variant == name]))
            for name in (DEFAULT, PAPER_CHOICE)
        )
        dissected = group[group.dissected & (group.variant == DEFAULT)]
        by_part = {part: own.to_numpy() for part, own in dissected.groupby("part").modes_nm}
        floor_nm, beside_nm = speckle_floor_nm(by_part) if by_part else (None, None)
        return {
            "samples": len(introduced_nm),
            "introduced_nm": np.mean(introduced_nm),
            "introduced_scatter_nm": np.std(introduced_nm),
            "ratio_to_dip_global": own_nm / other_nm,
            f"{DEFAULT}_nm": own_nm,
            f"{PAPER_CHOICE}_nm": other_nm,
            "speckle_floor_nm": floor_nm,
            "beside_floor_nm": beside_nm,
            "default_of_parts_nm": np.median(by_part[1.0]) if by_part else None,
            "samples_of_parts": len(by_part[1.0]) if by_part else None,
        }

    def errors(group, shape, seeing_arcsec, variant):
        found: dict[str, Any] = {"label": VARIANTS[variant].label, "method": METHOD_NAMES.get(variant)}
        found["samples"] = len(group)
        for name in ("modes_nm", "pupil_nm"):
            found |= ex.spreads(group, name) | ex.median_in_range(name, group[name])
            found[f"{name}_worst"] = group[name].max()
        return found | {"chi2_nu": np.median(group.chi2_nu)}

    in_order = {"by": "variant", "key": lambda variants: variants.map(METHODS.index), "kind": "stable"}
    of_all = whole[whole.variant.isin(METHODS)].sort_values(**in_order)
    of_parts = whole[whole.dissected & whole.variant.isin(PARTS)]
    shown = {
        "conditions": ex.grouped(rows, by, condition),
        "methods": ex.grouped(of_all, [*by, "variant"], errors),
        "parts": ex.grouped(of_parts, [*by, "variant"], errors),
    }
    return {name: table for name, table in shown.items() if len(table)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """NCPAs as in the paper, the default near its floor and well before the paper's choice."""
    conditions, of = tables["conditions"], "{shape}, {seeing_arcsec:g} arcsec"
    own_nm, floor_nm = "default_of_parts_nm", "speckle_floor_nm"
    introduced = conditions.assign(reach_nm=STANDARD_ERRORS * DRAWN_SCATTER_NM / np.sqrt(conditions.samples))
    return [
        *ex.checked(
            introduced, f"introduced NCPAs, {of}", "introduced_nm",
            f"{{introduced_nm:.0f}} nm in the mean of {{samples}} cubes, {DRAWN_NM:g} in the paper",
            low=lambda row: DRAWN_NM - row["reach_nm"], high=lambda row: DRAWN_NM + row["reach_nm"],
            unit="nm",
        ),
        *ex.checked(
            conditions[np.isfinite(conditions.speckle_floor_nm)],
            f"default over the floor of the speckles, {of}",
            lambda row: row[own_nm] / row[floor_nm] if row[floor_nm] > 0 else math.inf,
            "median {default_of_parts_nm:.1f} nm of {samples_of_parts:g} cubes, "
            "floor {speckle_floor_nm:.1f} nm", high=OVER_FLOOR,
        ),
        *ex.checked(
            conditions, f"default over DIP global, {of}", "ratio_to_dip_global",
            "medians {long_exposure_nm:.1f} and {dip_global_nm:.1f} nm", high=1 / SEVERAL_TIMES,
        ),
    ]  # fmt: skip


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
            "speckle floor [nm]": "{speckle_floor_nm:.1f}", "remainder": "{beside_floor_nm:.1f}",
        },
        caption="Median Δ-WFE in Noll 2–30, also where the residual's power spectrum is not of the "
        "modelled family. Speckle floor: the part of the default's error that falls as 1/√frames.",
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
    modelled, by_seeing = f"shape == '{MODEL_SHAPE}'", {"by": "seeing_arcsec", "kind": "stable"}
    table = drawn.tables["methods"].query(modelled).sort_values(**by_seeing)
    rows = drawn.rows().query(f"{modelled} and part == 1 and variant in {METHODS}").sort_values(**by_seeing)
    rows["named"] = rows.seeing_arcsec.map("{:g}″, ".format) + rows.variant.map(METHOD_NAMES)
    label = "Δ-WFE in Noll 2–30 [nm RMS]"
    return [
        ex.lines(
            "methods-seeing", "Error against seeing", "Medians; bars: 16th to 84th percentile.",
            table, "seeing_arcsec", "modes_nm",
            colour="method", labels=('seeing ["]', label), ends=("p16", "p84"),
        ),
        ex.strips(
            "methods-samples", "Distribution over cubes", "Every point is a cube with NCPAs of its own.",
            rows, {"modes_nm": "Noll 2–30"}, by="named", label=label,
        ),
    ]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "methods", 7, Sizes, "Calibration methods",
    samples, rows, tables, checks, LISTINGS, figures,
    "NCPAs of {introduced_nm:.0f} ± {introduced_scatter_nm:.0f} nm RMS; published methods have 29 modes.",
    "cubes",
)  # fmt: skip
