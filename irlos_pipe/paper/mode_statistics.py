"""Standard deviation per mode (paper, appendix A): many modes estimated on cubes with 50 simulated."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.mode_number import ModeLaw, ModeScatter, equalised_tilts, fit_mode_law, mode_scatter
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import calibrations
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, PAPER_CHOICE, ObservedCube
from irlos_pipe.report.section_series import Points, strength_plot
from irlos_pipe.stages.modes import LawRow

INTRODUCED = 51  # highest Noll mode of the simulated NCPAs
FIRST_FITTED = 4  # lowest mode in the fit of the law: tip and tilt hold the image motion of a finite cube
TRUTH = "introduced"
NAMES = {TRUTH: TRUTH} | {method: METHOD_NAMES[method] for method in (DEFAULT, PAPER_CHOICE)}


class Sizes(ex.StageConfig):
    cubes: int = Field(20, ge=2, le=1000, description="cubes, each with its own NCPAs of 50 modes")
    frames: int = Field(100, ge=10, le=10000, description="frames of a cube")
    published_frames: calibrations.PublishedFrames = 20
    highest_noll: int = Field(
        101, ge=INTRODUCED + 10, le=HIGHEST_NOLL, description="modes Noll 2 to this are estimated"
    )
    seeing_arcsec: float = Field(0.5, gt=0, le=5, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> ex.Samples:
    return ex.each(ctx, ctx.config.cubes, "cube {index}")


def rows(star: ex.Sample) -> ex.Rows:
    """Simulate a cube and estimate many modes by both methods, without a prior."""
    sizes = star.sizes
    cube = ObservedCube.of(star.cube(sizes.seeing_arcsec, sizes.frames, sizes.mag_j))
    introduced_nm = np.array([cube.scene.ncpa_nm.get(noll, 0.0) for noll in range(2, sizes.highest_noll + 1)])
    for method, count in calibrations.frames_per_method(sizes.frames, sizes.published_frames).items():
        options = CalibrationOptions(method, highest_noll=sizes.highest_noll)
        fit = cube.first(count).calibrated(calibrations.Variant(method, options, prior=False))
        yield {
            "method": method,
            "introduced_nm": introduced_nm,
            "zernike_nm": fit.zernike_nm,
            "sigma_nm": fit.sigma_nm,
            "error_nm": float(np.sqrt(np.sum((fit.zernike_nm - introduced_nm)[2:] ** 2))),  # beyond tilt
            "chi2_nu": fit.chi2_nu,
        }


def scatters(rows: ex.Frame) -> dict[str, ModeScatter]:
    """Return the scatter over the cubes of the introduced modes, and of the estimates of every method."""
    (true_nm,) = ex.stacked(rows[rows.method == DEFAULT], "introduced_nm")
    values = {TRUTH: [true_nm, np.zeros_like(true_nm)]}
    for method, own in rows.groupby("method", sort=False):
        values[method] = ex.stacked(own, "zernike_nm", "sigma_nm")
    nolls = list(range(2, true_nm.shape[1] + 2))
    return {name: equalised_tilts(mode_scatter(nolls, *own)) for name, own in values.items()}


def law_of(scatter: ModeScatter, start: NcpaLaw, last: int | None = None) -> ModeLaw:
    """Return the law of the estimates as they are, like the paper's; up to Noll `last`."""
    nolls = np.array(scatter.nolls)
    fitted = (nolls >= FIRST_FITTED) & (nolls <= (last or nolls[-1]))
    return fit_mode_law(scatter, fitted, start, remove_noise=False)


def beyond_nm(nolls: Sequence[int], std_nm: np.ndarray) -> float:
    """Return the RMS of the standard deviations of modes that were not introduced: cross-talk and noise."""
    return float(np.sqrt(np.mean(std_nm[np.asarray(nolls) > INTRODUCED] ** 2)))


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """What is found beyond the introduced modes, the laws, and the error of every cube."""
    start, found = ctx.instrument.facility.ncpa_law, scatters(rows)
    laws = {(f"Noll 4–{INTRODUCED}", name): law_of(one, start, INTRODUCED) for name, one in found.items()}
    laws |= {("all from Noll 4 on", name): law_of(one, start) for name, one in found.items() if name != TRUTH}
    cubes, estimated = ctx.config.cubes, ctx.config.highest_noll - 1
    counts = {"cubes": cubes, "modes_introduced": INTRODUCED - 1, "modes_estimated": estimated}

    def method(name, scatter):
        errors_nm = rows.error_nm[rows.method == name]
        median_nm = float(np.median(errors_nm)) if len(errors_nm) else None
        beyond = beyond_nm(scatter.nolls, scatter.std_nm)
        return {"name": name, "label": NAMES[name], "beyond_nm": beyond, "error_nm": median_nm, **counts}

    return {
        "methods": ex.frame(method(name, scatter) for name, scatter in found.items()),
        "laws": ex.frame(
            {"modes": modes, "name": name, "label": NAMES[name]} | LawRow.of(law).model_dump()
            for (modes, name), law in laws.items()
        ),
        "cubes": rows[["sample", "method", "error_nm"]],
    }


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default finds the law, each term within its standard error.

    Both laws are fitted to the same draws, so they differ by less than a fit's error, which is theirs.
    """
    laws = tables["laws"].query(f"modes == 'Noll 4–{INTRODUCED}'").set_index("name")
    found = []
    for column, error in (("A_nm", "A_sigma_nm"), ("B", "B_sigma"), ("C_nm", "C_sigma_nm")):
        value, sigma, introduced = laws[column][DEFAULT], laws[error][DEFAULT], laws[column][TRUTH]
        name = f"law of the default, term {column[0]}: deviation over standard error"
        text = f"{value:.3g} ± {sigma:.2g}, introduced {introduced:.3g}"
        found.append(ex.check(name, abs(value - introduced) / sigma, text, high=1.0))
    return found


LISTINGS = [
    ex.Listing("methods", "Modes that were not introduced",
        {
            "": "{label}", "RMS per mode beyond [nm]": "{beyond_nm:.2f}",
            "error from Noll 4 on, median [nm]": "{error_nm:.1f}",
        },
        caption="Beyond: modes that were not introduced; a perfect estimate finds nothing there.",
    ),
    ex.Listing("laws", "Law of the standard deviation",
        {
            "law": "{label}, {modes}", "A [nm]": "{A_nm:.1f} ± {A_sigma_nm:.1f}",
            "B": "{B:.3f} ± {B_sigma:.3f}", "C [nm]": "{C_nm:.1f} ± {C_sigma_nm:.1f}",
            "deviance/ν": "{deviance_nu:.2f}", "plateau from Noll": "{plateau_noll:.0f}",
        },
        caption="std(i) = A exp(−B i) + C, i = 0 for Noll 2; maximum likelihood. The plateau begins where "
        "the exponential is a tenth of C.",
    ),
]  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """Standard deviations with their laws: DIP global's of all modes, the others' of the introduced ones."""
    start, quantities = ctx.instrument.facility.ncpa_law, {}
    for name, one in scatters(rows).items():
        law = law_of(one, start, None if name == PAPER_CHOICE else INTRODUCED)
        text = f"{name}: RMS over the cubes"
        quantities[f"{name}/std_nm"] = ex.Quantity(one.std_nm, "nm", text, one.std_sigma_nm)
        quantities[f"{name}/noise_nm"] = ex.Quantity(one.noise_nm, "nm", "quoted error of the estimates")
        quantities[f"{name}/law_nm"] = ex.Quantity(law(list(one.nolls)), "nm", "fitted law")
        quantities["noll"] = ex.Quantity(np.array(one.nolls), "", "Noll index")
    return quantities


def figures(drawn: ex.Drawn) -> ex.Blocks:
    noll, points = drawn.array("noll"), {}
    for name, text in NAMES.items():
        std_nm, law_nm = drawn.array(f"{name}/std_nm"), drawn.array(f"{name}/law_nm")
        shown = np.where(std_nm > 0, std_nm, np.nan)
        points[text] = Points(noll, shown, None if name == TRUTH else law_nm)
    line = {"law of the introduced modes": np.stack([noll, drawn.array(f"{TRUTH}/law_nm")])}
    caption = (
        "RMS over the cubes, tip and tilt equalised. Lines: laws fitted from Noll 4 on, that of DIP global "
        "to all modes, the others to the introduced ones."
    )
    return [ex.Figure(strength_plot("mode-statistics", points, line), "Strength of the modes", caption)]


EXPERIMENT = ex.Experiment(
    "mode_statistics", 3, Sizes, "Standard deviation of the modes, simulated",
    samples, rows, tables, checks, LISTINGS, figures,
    "{modes_estimated} modes estimated in {cubes} cubes with NCPAs of {modes_introduced} modes: what an "
    "estimate contains of the others is cross-talk and noise.", "cubes", arrays,
)  # fmt: skip
