"""Error of Noll 2–30 against the number of estimated modes, where 50 were introduced (paper, appendix B)."""

import numpy as np
from pydantic import Field, field_validator

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.mode_number import choose, fit_mode_numbers, scan_mode_numbers
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import calibrations
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, PAPER_CHOICE, ObservedCube
from irlos_pipe.paper.common.observation import NoiseOf, Read, as_read

LIFT = "lift_avg"
MODES_INTRODUCED = 50
LAST = MODES_INTRODUCED + 1  # highest Noll mode introduced
HELD_OUT = "held-out frames"
# The default has its prior; the others have none, as published.
METHODS = {
    name: calibrations.Variant(name, CalibrationOptions(name), prior=name == DEFAULT)
    for name in (DEFAULT, PAPER_CHOICE, LIFT)
}


class Sizes(ex.StageConfig):
    cubes: int = Field(4, ge=1, le=1000, description="cubes, each with its own NCPAs of 50 modes")
    frames: int = Field(200, ge=32, le=10000, description="frames of a cube")
    published_frames: calibrations.PublishedFrames = 20
    numbers: tuple[int, ...] = Field(
        (16, 21, 31, 41, 51, 61, 81, 101), min_length=2, description="highest Noll modes estimated"
    )
    magnitudes: tuple[float, ...] = Field(
        (7.0, 14.0, 16.0, 18.0), min_length=1, description="of the star, in J"
    )
    seeing_arcsec: float = Field(0.5, gt=0, le=5, description="seeing on SPARTA's scale")
    noise: NoiseOf = "reads"

    @field_validator("numbers")
    @classmethod
    def _rising(cls, numbers: tuple[int, ...]) -> tuple[int, ...]:
        if list(numbers) != sorted(set(numbers)) or numbers[0] < 4 or numbers[-1] > HIGHEST_NOLL:
            raise ValueError(f"give rising numbers between 4 and {HIGHEST_NOLL}")
        return numbers


def samples(ctx: ex.Context) -> ex.Samples:
    read = Read.of(ctx.instrument, ctx.config.noise, "mode_number")
    return ex.each(ctx, ctx.config.cubes, "cube {index}", read=read)


def rows(star: ex.Sample) -> ex.Rows:
    """Dim the cube and estimate few and many modes; what held-out frames recommend to the default.

    The default begins every number of modes from the one before; the published methods begin from none.
    """
    sizes = star.sizes
    scene = star.cube(sizes.seeing_arcsec, sizes.frames, sizes.magnitudes[0])
    cube = ObservedCube.of(as_read(scene, star["read"]))
    options = METHODS[DEFAULT].options_with(star.facility.ncpa_law)
    frames = calibrations.frames_per_method(sizes.frames, sizes.published_frames) | {LIFT: sizes.frames}
    for method in METHODS:
        # The paper's calibration is meant for bright stars only.
        for mag_j in sizes.magnitudes[:1] if method == PAPER_CHOICE else sizes.magnitudes:
            own = cube.dimmed(mag_j).first(frames[method])
            if method == DEFAULT:
                fits = fit_mode_numbers(own.frames, own.settings, options, sizes.numbers, own.effects)
            else:
                fits = [own.calibrated(METHODS[method].with_modes(highest)) for highest in sizes.numbers]
            for highest, fit in zip(sizes.numbers, fits, strict=True):
                error_nm = own.modes_delta_nm(fit)
                yield {"method": method, "mag_j": mag_j, "highest_noll": highest, "error_nm": error_nm}
    bright = cube.dimmed(sizes.magnitudes[0])
    scan = scan_mode_numbers(bright.frames, bright.settings, options, sizes.numbers, bright.effects)
    recommended = scan.highest_nolls[choose(scan.misfit).recommended]
    for highest, misfit in zip(sizes.numbers, scan.misfit.mean(axis=1), strict=True):
        found = {"held_out_chi2_nu": misfit, "recommended_noll": recommended}
        yield {"method": HELD_OUT, "mag_j": sizes.magnitudes[0], "highest_noll": highest, **found}


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Median and extremes over the cubes, and what each cube recommends."""

    def curve(group, method, *_):
        error_nm, of_all = group.error_nm, {"cubes": len(group), "modes_introduced": MODES_INTRODUCED}
        numbers = {"median_nm": np.median(error_nm), "least_nm": error_nm.min(), "worst_nm": error_nm.max()}
        return {"label": METHOD_NAMES[method], **numbers, **of_all}

    curves, held_out = rows[rows.method != HELD_OUT], rows[rows.method == HELD_OUT]
    recommended = held_out.drop_duplicates("sample")[["sample", "recommended_noll"]]
    return {
        "curves": ex.grouped(curves, ["method", "mag_j", "highest_noll"], curve),
        "cubes": recommended.astype({"recommended_noll": int}),
    }


def checks(tables: ex.Tables) -> list[ex.Check]:
    """DIP is best at the number introduced (the paper's appendix B), and held-out frames give this number."""
    curves, recommended = tables["curves"].query(f"method == '{PAPER_CHOICE}'"), tables["cubes"]
    others = int((recommended.recommended_noll != LAST).sum())
    return [
        *ex.checked(
            curves.loc[curves.groupby("mag_j", sort=False).median_nm.idxmin()],
            "modes from those introduced to DIP global's best, m_J {mag_j:g}",
            lambda row: abs(row["highest_noll"] - LAST),
            f"best to Noll {{highest_noll}}, introduced to Noll {LAST}", high=0,
        ),
        ex.check(
            "cubes whose held-out frames choose another number than the introduced one",
            others, f"{others} of {len(recommended)}", high=len(recommended) / 2,
        ),
    ]  # fmt: skip


LISTINGS = [
    ex.Listing("curves", "Error against the highest Noll mode that is estimated",
        {"method": "{label}", "m_J": "{mag_j:g}"},
        {"{highest_noll}": "{median_nm:.1f}"},
        caption="Medians over {cubes} cubes of the error in Noll 2–30 [nm RMS].",
    ),
    ex.Listing("cubes", "Recommended by unseen frames",
        {"cube": "{sample}", "modes": "Noll 2–{recommended_noll}"},
        caption="By the misfit of frames that no fit of the default has seen, without the truth.",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Medians against the number of modes: calibration of bright cubes, and LIFT of their mean image."""
    curves = drawn.tables["curves"]
    curves = curves.assign(line=curves.label + ", m_J " + curves.mag_j.map("{:g}".format))
    caption = f"Medians over the cubes. Dotted: the introduced modes, Noll 2–{LAST}."
    parts = {"Calibration": curves[curves.method != LIFT], METHOD_NAMES[LIFT]: curves[curves.method == LIFT]}
    return [
        ex.lines(
            f"number-{title.split()[0].lower()}", title, caption, part, "highest_noll", "median_nm",
            colour="line", labels=("highest Noll mode estimated", "Δ-WFE in Noll 2–30 [nm]"), marks=[LAST],
        )
        for title, part in parts.items()
    ]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "mode_number", 6, Sizes, "Number of modes, simulated",
    samples, rows, tables, checks, LISTINGS, figures,
    "{cubes} cubes with NCPAs of {modes_introduced} modes, fitted with fewer and with more.", "cubes",
)  # fmt: skip
