"""Calibration methods against the length of an exposure, with the same light (paper, Sect. 5.1).

Frames of the shortest exposure follow one another without a gap; longer ones are their sums before the noise.
So all cubes of a sample show the same star and AO residual for the same time, each with its own noise.
"""

from dataclasses import replace

from pydantic import Field

from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, VARIANTS, ObservedCube

STEADY = 1.5  # largest over smallest error of the default between exposures: it fits the mean image

LISTING = ex.Listing("methods", "Exposures",
    {'seeing ["]': "{seeing_arcsec}", "method": "{label}"},
    {"{exposure_s:g} s": "{modes_nm:.1f}"},
    caption="Δ-WFE in Noll 2–30 [nm RMS], medians over {cubes} cubes of {total_s:.0f} s at each seeing; "
    "m_J 7.",
)  # fmt: skip


class Sizes(ex.StageConfig):
    samples: int = Field(3, ge=1, le=1000, description="cubes at each seeing")
    seeings_arcsec: tuple[float, ...] = Field((0.35, 1.0), min_length=1, description="on SPARTA's scale")
    shortest_s: float = Field(0.02, gt=0, le=10, description="shortest exposure [s]")
    sums: tuple[int, ...] = Field(
        (1, 5, 10, 25, 50), min_length=1, description="shortest exposures that are added to one"
    )
    frames: int = Field(500, ge=4, le=100000, description="shortest exposures of a cube")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")
    methods: tuple[str, ...] = Field(tuple(METHOD_NAMES), min_length=1, description="methods compared")


def samples(ctx: ex.Context) -> ex.Samples:
    """One star at one seeing; the n-th of every seeing has the same NCPAs."""
    for seeing in ctx.config.seeings_arcsec:
        name = "{seeing_arcsec:g} arcsec, cube {index}"
        yield from ex.each(ctx, ctx.config.samples, name, seeing_arcsec=seeing)


def rows(star: ex.Sample) -> ex.Rows:
    """Calibrate every sum of the exposures by every method."""
    sizes = star.sizes
    of_cube = star["seeing_arcsec"], sizes.frames, sizes.mag_j
    exposure = {"exposure_s": sizes.shortest_s, "frame_rate_hz": 1 / sizes.shortest_s}
    shortest = ObservedCube.of(star.cube(*of_cube, **exposure))
    for count in sizes.sums:
        cube, exposure_s = summed(shortest, count), sizes.shortest_s * count
        for method in sizes.methods:
            yield {"method": method, "exposure_s": exposure_s, "modes_nm": cube.error_nm(VARIANTS[method])}


def summed(cube: ObservedCube, count: int) -> ObservedCube:
    """Return a cube whose exposures are each the sum of `count` of those of another, with noise of its own.

    Frames that do not fill an exposure are left out.
    """
    if count == 1:
        return cube
    frames = cube.scene.frames // count
    mean_e, zernike_nm = (
        one[: frames * count].reshape(frames, count, *one.shape[1:])
        for one in (cube.exposed.mean_e, cube.exposed.zernike_nm)
    )
    exposed = replace(cube.exposed, mean_e=mean_e.sum(axis=1), zernike_nm=zernike_nm.mean(axis=1))
    time_s, seed = cube.scene.exposure_s * count, (*cube.scene.seed, count)
    scene = replace(cube.scene, frames=frames, exposure_s=time_s, frame_rate_hz=1 / time_s, seed=seed)
    return ObservedCube.of(scene, exposed)


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Errors of Noll 2–30 over the cubes of a seeing."""
    total_s = ctx.config.shortest_s * ctx.config.frames

    def errors(group, seeing_arcsec, method, exposure_s):
        label = {"label": METHOD_NAMES.get(method, method)}
        return label | ex.spreads(group, "modes_nm") | {"cubes": len(group), "total_s": total_s}

    return {"methods": ex.grouped(rows, ["seeing_arcsec", "method", "exposure_s"], errors)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The exposure does not matter to the default."""
    default = tables["methods"].query(f"method == '{DEFAULT}'").groupby("seeing_arcsec", sort=False)
    return ex.checked(
        default.modes_nm.agg(["min", "max"]).reset_index(),
        "default's worst over its best exposure, {seeing_arcsec:g} arcsec",
        lambda row: row["max"] / row["min"], "medians from {min:.1f} to {max:.1f} nm", high=STEADY,
    )  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    caption = "Medians over the cubes, by the seeing [arcsec]. All exposures are sums of the same short ones."
    return [ex.lines(
        "exposures", "Error against exposure", caption, drawn.tables["methods"], "exposure_s", "modes_nm",
        colour="label", panels="seeing_arcsec", labels=("exposure [s]", "Δ-WFE in Noll 2–30 [nm]"),
        size=(9.0, 4.4), width="full", xscale="log",
    )]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "exposures", 3, Sizes, "Length of an exposure",
    samples, rows, tables, checks, [LISTING], figures,
    "{cubes} cubes at each seeing, {total_s:g} s of light in each.", "cubes",
)  # fmt: skip
