"""Calibration methods against the length of an exposure, with the same light (paper, Sect. 5.1).

Frames of the shortest exposure follow one another without a gap; longer ones are their sums before the noise.
So all cubes of a sample show the same star and AO residual for the same time, each with its own noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from pydantic import Field

from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.cube import ObservedCube
from irlos_pipe.paper.common.observation import frames_of
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, VARIANTS

STEADY = 1.5  # the default may change by so much from one exposure to another: it fits the mean image


class Sizes(ex.StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="cubes at each seeing")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), min_length=1, description="on SPARTA's scale")
    shortest_s: float = Field(0.02, gt=0, le=10, description="shortest exposure [s]")
    sums: tuple[int, ...] = Field(
        (1, 5, 10, 25, 50), min_length=1, description="shortest exposures that are added to one"
    )
    frames: int = Field(500, ge=4, le=100000, description="shortest exposures of a cube")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")
    methods: tuple[str, ...] = Field(tuple(METHOD_NAMES), min_length=1, description="methods compared")


def samples(ctx: ex.Context) -> Iterator[ex.Sample]:
    """One star at one seeing; the n-th of every seeing has the same NCPAs."""
    for seeing in ctx.config.seeings_arcsec:
        for index in range(ctx.config.samples):
            yield ex.sample(ctx, f"{seeing:g} arcsec, cube {index}", index, seeing_arcsec=seeing)


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate every sum of the exposures by every method."""
    sizes = star.sizes
    scene = star.cube(star["seeing_arcsec"], sizes.frames, sizes.mag_j)
    scene = replace(scene, exposure_s=sizes.shortest_s, frame_rate_hz=1 / sizes.shortest_s)
    shortest = ObservedCube.of(scene)
    for count in sizes.sums:
        cube = summed(shortest, count)
        for method in sizes.methods:
            error_nm = cube.modes_delta_nm(cube.calibrated(VARIANTS[method]))
            yield {"method": method, "exposure_s": sizes.shortest_s * count, "modes_nm": error_nm}


def summed(cube: ObservedCube, count: int) -> ObservedCube:
    """Return a cube whose exposures are each the sum of `count` of those of another, with noise of its own.

    Frames that do not fill an exposure are left out.
    """
    if count == 1:
        return cube
    frames = cube.scene.frames // count
    used = frames * count
    mean_e = cube.exposed.mean_e[:used]
    exposed = replace(
        cube.exposed,
        mean_e=mean_e.reshape(frames, count, *mean_e.shape[1:]).sum(axis=1),
        zernike_nm=cube.exposed.zernike_nm[:used].reshape(frames, count, -1).mean(axis=1),
    )
    exposure_s = cube.scene.exposure_s * count
    scene = replace(
        cube.scene,
        frames=frames,
        exposure_s=exposure_s,
        frame_rate_hz=1 / exposure_s,
        seed=(*cube.scene.seed, count),
    )
    return ObservedCube(scene, exposed, frames_of(scene, exposed))


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Errors of Noll 2–30 over the cubes of a seeing."""

    def summary(group: ex.Frame) -> dict[str, Any]:
        label = METHOD_NAMES.get(group.method.iloc[0], group.method.iloc[0])
        total_s = ctx.config.shortest_s * ctx.config.frames
        return {"label": label, **ex.spreads(group, "modes_nm"), "cubes": len(group), "total_s": total_s}

    return {"methods": ex.grouped(rows, ["seeing_arcsec", "method", "exposure_s"], summary)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The exposure does not matter to the default."""
    found, table = [], tables["methods"]
    for seeing, row in table[table.method == DEFAULT].groupby("seeing_arcsec", sort=False):
        best, worst = row.modes_nm.min(), row.modes_nm.max()
        name = f"default's worst over its best exposure, {seeing:g} arcsec"
        found.append(ex.at_most(name, worst / best, STEADY, f"medians from {best:.1f} to {worst:.1f} nm"))
    return found


LISTING = ex.Listing("methods", "Exposures",
    {'seeing ["]': "{seeing_arcsec}", "method": "{label}"},
    {"{exposure_s:g} s": "{modes_nm:.1f}"},
    caption="Δ-WFE in Noll 2–30 [nm RMS], medians over {cubes} cubes of {total_s:.0f} s at each seeing; "
    "m_J 7.",
    page="exposures",
)  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Error against exposure."""
    labels = ("exposure [s]", "Δ-WFE in Noll 2–30 [nm]")
    drawing = ex.lines(
        "exposures",
        drawn.tables["methods"],
        "exposure_s",
        "modes_nm",
        colour="label",
        panels="seeing_arcsec",
        labels=labels,
        size=(9.0, 4.4),
        xscale="log",
    )
    caption = "Medians over the cubes, by the seeing [arcsec]. All exposures are sums of the same short ones."
    return [ex.Figure(drawing, "Error against exposure", caption, "full")]


EXPERIMENT = ex.Experiment(
    "exposures", 3, Sizes, "Length of an exposure",
    samples, rows, tables, checks, [LISTING], figures,
    "{cubes} cubes at each seeing, {total_s:g} s of light in each.", "cubes",
)  # fmt: skip
