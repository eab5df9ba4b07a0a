"""From how far LIFT finds the defocus of a single frame, by where its iteration starts.

A sample is a ramp: one set of NCPAs, known as well as a calibration knows them, and a number of frames of
random defocus, pointing and AO residual. Every frame is estimated from every start.
"""

from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure as Canvas
from pydantic import Field

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.effects import expected
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import METHODS, LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, start_from_defocus
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT
from irlos_pipe.paper.common.observation import frame_settings, images_of, model_effects_of, noise_of
from irlos_pipe.paper.common.ramps import TTF, elongation_defocus_nm, from_every_start
from irlos_pipe.paper.common.scenes import J_AND_H, NCPA_NM, star_scene
from irlos_pipe.report.drawing import BLUE, FAINT, svg
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Scene, draw_ncpa_nm

PAPER_NM = 410.0  # capture range that the paper states, started from zero
# Right estimates err by less than 20 nm (AO residual, calibration, noise), wrong ones by hundreds: the next
# minimum of χ² lies near the opposite defocus. Any limit between gives the same counts; both are reported.
WRONG_NM = 50.0
BOTH, H_ALONE = "J+H", "H"
DRAWN = {"elongation": "start_nm", "scan": "start_nm", "zero": "defocus_nm", "default": "defocus_nm"}

CELLS = {
    "start of LIFT": "{start}", "cases within ±600 nm": "{required_cases}", "captured": "{required_captured}",
    "wrong": "{required_wrong}", "flagged": "{required_flagged}",
    "largest error among the captured [nm]": "{largest_right_nm:.0f}",
    "every case captured up to [nm]": "{range_nm:.0f}", "error of the captured [nm RMS]": "{rms_nm:.1f}",
    "smallest wrong error [nm]": "{smallest_wrong_nm:.0f}",
}  # fmt: skip
CAPTION = (
    "Captured: converged, and within {wrong_limit_nm:.0f} nm of the truth. Wrong: converged elsewhere. "
    "Flagged: not converged, and says so. Of {all_cases} cases in all"
)


class Sizes(ex.StageConfig):
    ramps: int = Field(30, ge=1, le=10000, description="sets of NCPAs")
    h_ramps: int = Field(10, ge=0, le=10000, description="further sets, known exactly, in H alone")
    frames: int = Field(50, ge=1, le=1000, description="frames with each set of NCPAs")
    reach_nm: float = Field(900.0, gt=0, le=1500, description="defocus is uniform within ± this [nm RMS]")
    required_nm: float = Field(600.0, gt=0, description="capture range that is asked for [nm RMS]")
    shift_px: float = Field(2.0, ge=0, le=10, description="star within ± this of the centre, each axis [px]")
    mag_j: float = Field(12.0, ge=0, le=25, description="J magnitude of the star")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    calibration_error_nm: float = Field(15.0, ge=0, description="error of the NCPAs given to LIFT [nm RMS]")
    bin_nm: float = Field(100.0, gt=0, description="width of the bins of the success curve [nm RMS]")


def samples(ctx: ex.Context) -> ex.Samples:
    """Ramps in J and H, and in H alone with the NCPAs known exactly, for which the paper states a range."""
    sizes = ctx.config
    yield from ex.each(ctx, sizes.ramps, "ramp {index}", bands=BOTH, known_to_nm=sizes.calibration_error_nm)
    yield from ex.each(ctx, sizes.h_ramps, "ramp {index}", bands=H_ALONE, known_to_nm=0.0)


def rows(star: ex.Sample) -> ex.Rows:
    """Estimate every frame from every start."""
    scene, data, known_nm = simulate_ramp(star)
    psf = PsfModel(frame_settings(scene, known_nm), TTF)
    model = ImageModel(psf, expected(model_effects_of(scene)))
    prior_nm = elongation_defocus_nm(scene, data) - known_nm.get(DEFOCUS, 0.0)
    elongation_nm = start_from_defocus(psf, data, prior_nm)
    for name, (start_nm, result) in from_every_start(model, data, elongation_nm, LiftOptions()).items():
        defocus_nm, sigma_nm = result.mode(DEFOCUS)
        columns = {
            "true_nm": data.introduced_nm,
            "start_nm": start_nm[:, TTF.index(DEFOCUS)].numpy(),
            "defocus_nm": defocus_nm.numpy(),
            "sigma_nm": sigma_nm.numpy(),
            "converged": result.solution.converged.numpy(),
            "chi2_nu": result.chi2_nu.numpy(),
        }
        for frame, values in enumerate(zip(*columns.values(), strict=True)):
            yield {"start": name, "frame": frame} | dict(zip(columns, values, strict=True))


def simulate_ramp(star: ex.Sample) -> tuple[Scene, RampData, dict[int, float]]:
    """Return the frames of a sample, each with a sky of its own, and what an observer knows of their NCPAs.

    The scene is that of the first frame; the introduced defocus of the data is the truth: with that of the AO
    residual, without the NCPAs.
    """
    rng, sizes = np.random.default_rng(star.seed), star.sizes
    ncpa_nm = draw_ncpa_nm(rng, star.facility.ncpa_law, NCPA_NM)
    introduced_nm = rng.uniform(-sizes.reach_nm, sizes.reach_nm, sizes.frames)
    shifts_px = rng.uniform(-sizes.shift_px, sizes.shift_px, (sizes.frames, 2))
    scenes = [
        _frame_scene(star, index, ncpa_nm, shift, float(defocus))
        for index, (defocus, shift) in enumerate(zip(introduced_nm, shifts_px, strict=True))
    ]
    exposed = [expose(scene) for scene in scenes]
    focus_nm = np.array([one.zernike_nm[0, DEFOCUS - 2] - ncpa_nm[DEFOCUS] for one in exposed])
    images = torch.cat([images_of(scene, one) for scene, one in zip(scenes, exposed, strict=True)])
    good = torch.ones(images.shape[1:], dtype=torch.bool)
    data = RampData(images, good, noise_of(scenes[0]), introduced_nm + focus_nm)
    # As calibrated: an error of the same size in all modes that the default calibration estimates.
    nolls = range(2, METHODS[DEFAULT].highest_noll + 1)
    errors_nm = star["known_to_nm"] / np.sqrt(len(nolls)) * rng.standard_normal(len(nolls))
    known_nm = {noll: ncpa_nm.get(noll, 0.0) + float(one) for noll, one in zip(nolls, errors_nm, strict=True)}
    return scenes[0], data, known_nm


def _frame_scene(
    star: ex.Sample, index: int, ncpa_nm: dict[int, float], shift_px: np.ndarray, defocus_nm: float
) -> Scene:
    of = f"{star.name}, frame {index}", star.facility, (*star.seed, index), 1, star.sizes.mag_j
    scene = star_scene(*of, ncpa_nm, defocus_nm, seeing_arcsec=star.sizes.seeing_arcsec)
    pixel_nm = tilt_nm(scene.pixel_scale_mas, star.facility.pupil.diameter_m)
    tilts_nm = {noll: ncpa_nm[noll] + float(px) * pixel_nm for noll, px in zip((2, 3), shift_px, strict=True)}
    scene = replace(scene, ncpa_nm={**ncpa_nm, **tilts_nm})
    if star["bands"] == BOTH:
        return scene
    h = J_AND_H[-1]
    return replace(scene, bands=(Band.of(h),), throughput=scene.throughput * h.share)


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """What came of every start, all together and in bins of true defocus.

    Captured are estimates that are right and reported as right, wrong those that are reported as right and
    are not, flagged those that are reported as failed.
    """
    sizes = ctx.config
    edges_nm = np.linspace(-sizes.reach_nm, sizes.reach_nm, round(2 * sizes.reach_nm / sizes.bin_nm) + 1)
    limits = {"required_nm": sizes.required_nm, "paper_nm": PAPER_NM, "wrong_limit_nm": WRONG_NM}
    rows = rows.assign(error_nm=(rows.defocus_nm - rows.true_nm).abs(), size_nm=rows.true_nm.abs())
    rows["captured"] = rows.converged & (rows.error_nm <= WRONG_NM)
    rows["wrong"], rows["flagged"] = rows.converged & ~rows.captured, ~rows.converged

    def start(group, *_):
        required = group[group.size_nm <= sizes.required_nm]
        within_nm = required.error_nm[required.captured].to_numpy()
        lost_nm = group.size_nm[~group.captured]
        counts = {
            f"{name}_{what}": int(cases[what].sum()) if what != "cases" else len(cases)
            for name, cases in (("required", required), ("all", group))
            for what in ("cases", "captured", "wrong", "flagged")
        }
        return counts | {
            # Defocus up to which every case was captured.
            "range_nm": float(lost_nm.min() if len(lost_nm) else group.size_nm.max()),
            "rms_nm": float(np.sqrt(np.mean(within_nm**2))) if len(within_nm) else None,
            "largest_right_nm": group.error_nm[group.captured].max(),
            "smallest_wrong_nm": group.error_nm[group.wrong].min(),
            **limits,
            "mag_j": sizes.mag_j,
        }

    def bins(group, *_):
        true_nm = group.true_nm[group.captured], group.true_nm
        counts = (np.histogram(one, edges_nm)[0] for one in true_nm)
        columns = edges_nm[:-1], edges_nm[1:], *counts
        names = ("from_nm", "to_nm", "captured", "cases")
        return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]

    by = ["bands", "start"]
    return {"starts": ex.grouped(rows, by, start), "bins": ex.grouped(rows, by, bins)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default finds all within the required range."""
    return ex.checked(
        tables["starts"].query(f"bands == '{BOTH}' and start == 'default'"),
        "defocus not found within the required range",
        lambda row: row["required_cases"] - row["required_captured"],
        "{value:.0f} of {required_cases} cases were not found by the default", high=0,
    )  # fmt: skip


LISTINGS = [
    ex.Listing("starts", "Starts compared",
        CELLS,
        where=f"bands == '{BOTH}'", caption=CAPTION + ".",
    ),
    ex.Listing("starts", "Starts compared in H",
        CELLS,
        where=f"bands == '{H_ALONE}'",
        caption=CAPTION + ", their NCPAs known exactly: for H the paper states ±{paper_nm:.0f} nm from zero.",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Success against defocus, where the iteration starts, and where it ends."""
    bins, sizes = drawn.tables["bins"].query(f"bands == '{BOTH}'"), drawn.sizes
    bins = bins.assign(middle_nm=(bins.from_nm + bins.to_nm) / 2, part=100 * bins.captured / bins.cases)
    against = (
        "Elongation and scan: where the iteration starts; zero and default: where it ends. Most wrong "
        "estimates lie near the opposite defocus, whose image is the most similar one."
    )
    reach_nm = 1.1 * sizes["reach_nm"]
    rows = drawn.rows()

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for axes, (start, column) in zip(panels.ravel(), DRAWN.items(), strict=True):
            own = rows[(rows.bands == BOTH) & (rows.start == start)]
            axes.plot((-reach_nm, reach_nm), (-reach_nm, reach_nm), color=FAINT, linewidth=0.8)
            axes.plot(own.true_nm, own[column].clip(-reach_nm, reach_nm), ".", color=BLUE, markersize=2.5)
            axes.set(title=f"{start}, {'start' if column == 'start_nm' else 'estimate'}", aspect="equal")
        figure.supxlabel("true defocus [nm RMS]")

    return [
        ex.lines(
            "capture-success", "Success against defocus",
            "Frames whose defocus is found. Dotted: ranges that the paper states from zero, and asked for.",
            bins, "middle_nm", "part",
            colour="start", labels=("true defocus [nm RMS]", "captured [%]"), yscale="linear",
            marks=[side * one for one in (PAPER_NM, sizes["required_nm"]) for side in (-1, 1)],
        ),
        ex.Figure(svg("capture-against-truth", (5.2, 5.4), draw), "Starts and estimates", against),
    ]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "capture", 8, Sizes, "Capture range of LIFT",
    samples, rows, tables, checks, LISTINGS, figures,
    "m_J {mag_j:g}, J and H, 1 s: from ±{required_nm:.0f} nm RMS every frame is to be found.", "ramps",
)  # fmt: skip
