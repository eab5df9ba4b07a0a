"""How faint LIFT goes with and without calibrated NCPAs (paper, Fig. "sensitivity").

As in the paper's test, bright frames of the narrow H band are dimmed and the missing noise is put back.
Every variant of LIFT sees the same dimmed frames, and starts from zero defocus as a closed loop would.
"""

import math

import numpy as np
import torch
from pydantic import Field, model_validator

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import MEDIAN_OF_NORMAL
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.sensitivity import Configuration, Criterion, curve_of, scan
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import observation
from irlos_pipe.paper.common.ramps import LIFT_VARIANTS, calibrated, narrow_ramp, observe, offsets_nm
from irlos_pipe.paper.common.scenes import BY_MIRROR, FINE
from irlos_pipe.report.drawing import BLUE, GREEN, ORANGE
from irlos_pipe.report.section_lift import Look, sensitivity_plot
from irlos_pipe.stages.sensitivity import CriterionRow, CurveRow

LABELS = {"none": "no NCPAs", "published": "NCPAs by DIP global", "default": "this pipeline"}
COMPARED = tuple(f"{kind}_{modes}" for kind in LABELS for modes in (3, 9))
SIGNAL_VARIANT = "default_9"  # the best model gives the noise-free signal of the frames that are dimmed
OVER_THEORY = 1.5
COLOURS = {"none": ORANGE, "published": GREEN, "default": BLUE}


class Sizes(ex.StageConfig):
    samples: int = Field(2, ge=1, le=1000, description="sets of NCPAs, pooled in every curve")
    reach_nm: float = Field(170.0, gt=0, le=600, description="the ramp goes from minus to plus this [nm RMS]")
    offsets: int = Field(7, ge=2, le=200, description="positions of the ramp, one frame each")
    realisations: int = Field(10, ge=1, le=1000, description="of the noise, per frame and magnitude")
    exposures_s: tuple[float, ...] = Field((0.1, 1.0), min_length=1, description="lengths of an exposure")
    faintest_mag_j: tuple[float, ...] = Field((19.0, 21.0), description="for each length of exposure")
    magnitudes: int = Field(9, ge=1, le=50, description="of the scan, the faintest one included")
    mag_step: float = Field(1.0, gt=0, le=5, description="step of the magnitudes")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    mag_j: float = Field(7.1, ge=0, le=20, description="of the frames that are dimmed")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="by MASS-DIMM")
    limit_nm: float = Field(30.0, gt=0, description="limiting magnitude: largest median error [nm RMS]")
    limit_failures: float = Field(0.1, ge=0, le=1, description="limiting magnitude: largest part of failures")
    noise: observation.NoiseOf = "reads"

    @model_validator(mode="after")
    def _usable_magnitudes(self) -> "Sizes":
        if len(self.faintest_mag_j) != len(self.exposures_s):
            raise ValueError("faintest_mag_j needs one value for each of exposures_s")
        brightest = min(self.faintest_mag_j) - (self.magnitudes - 1) * self.mag_step
        if brightest < self.mag_j:
            raise ValueError(
                f"the scan would begin at {brightest:g}, brighter than mag_j {self.mag_j:g}: frames can only "
                "be dimmed; lower magnitudes or mag_step"
            )
        return self


def samples(ctx: ex.Context) -> ex.Samples:
    """One set of NCPAs each, at the seeing on SPARTA's scale."""
    seeing = observation.on_spartas_scale(ctx.instrument, ctx.config.seeing_arcsec)
    read = observation.Read.of(ctx.instrument, ctx.config.noise, "faint")
    return ex.each(ctx, ctx.config.samples, "sample {index}", sparta_arcsec=seeing, read=read)


def rows(star: ex.Sample) -> ex.Rows:
    """Dim a ramp of every length of exposure, and estimate it by every variant at every magnitude."""
    sizes, read = star.sizes, star["read"]
    # Without defocus: a sensor that does not know the NCPAs measures theirs rightly, but errors count against
    # the introduced defocus.
    of_cube = star["sparta_arcsec"], sizes.cube_frames, sizes.mag_j
    cube = star.cube(*of_cube, without=(DEFOCUS,), sampling=FINE, **BY_MIRROR)
    knowledge = calibrated(cube, [LIFT_VARIANTS[key].ncpa for key in COMPARED])
    for index, (exposure_s, faintest) in enumerate(zip(sizes.exposures_s, sizes.faintest_mag_j, strict=True)):
        ramp = narrow_ramp(cube, exposure_s, offsets_nm(sizes.reach_nm, sizes.offsets), index)
        observed = observe(ramp, knowledge)
        data, signal_e = observed.data, observed.estimate(LIFT_VARIANTS[SIGNAL_VARIANT]).result.model_e
        magnitudes = faintest - np.arange(sizes.magnitudes)[::-1] * sizes.mag_step
        of_reads = observation.exposure_noise(observation.as_read(ramp, read))
        faint = of_reads.beyond(observation.noise_of(ramp)) if read else None
        configurations = [
            Configuration(
                ImageModel(observed.model(variant), observed.effects(variant)),
                signal_e,
                torch.zeros(len(data.images_e), len(variant.modes), dtype=torch.float64),
            )
            for variant in (LIFT_VARIANTS[key] for key in COMPARED)
        ]
        curves = scan(
            configurations,
            data,
            sizes.mag_j,
            magnitudes,
            sizes.realisations,
            Criterion(np.inf, 1.0),  # the limit is that of all samples together
            star.seed[-1],
            faint=faint,
        )
        for key, curve in zip(COMPARED, curves, strict=True):
            yield {
                "exposure_s": exposure_s,
                "key": key,
                "magnitudes": magnitudes,
                "abs_error_nm": curve.abs_error_nm,
                "crb_nm": curve.crb_nm,
                "one_read_crb_nm": curve.one_read_crb_nm,
                # of the AO residual, mean of a frame
                "residual_nm": observed.exposed.zernike_nm[:, DEFOCUS - 2],
            }


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Limits of all variants, all samples pooled, and their errors at every magnitude."""
    sizes, criterion = ctx.config, Criterion(ctx.config.limit_nm, ctx.config.limit_failures)
    names = ("mag_j", "median_abs_error_nm", "p16_nm", "p84_nm", "crb_nm", "one_read_crb_nm", "failures")

    def curve_of_all(group, key):
        bound_nm, one_read_nm = (
            np.median(list(group[name]), axis=0) for name in ("crb_nm", "one_read_crb_nm")
        )
        of_all = LIFT_VARIANTS[key].modes, group.magnitudes.iloc[0]
        errors_nm = np.concatenate(list(group.abs_error_nm), axis=1)
        return curve_of(*of_all, errors_nm, bound_nm, one_read_nm, criterion)

    def limit(group, exposure_s, key):
        variant, curve = LIFT_VARIANTS[key], curve_of_all(group, key)
        residual_nm = np.concatenate(list(group.residual_nm))
        return {
            "label": variant.name, "modes": len(variant.modes), "calibrated": bool(variant.ncpa),
            "trials": curve.trials, "limit_mag": curve.limit_mag,
            "one_read_bound_mag": curve.bound_mag(criterion),
            # A perfect sensor errs by the defocus that the AO residual has of its own in every frame.
            "residual_floor_nm": float(MEDIAN_OF_NORMAL * np.sqrt(np.mean(residual_nm**2))),
            "bright_error_nm": curve.median_abs_error_nm[0], "bright_crb_nm": curve.crb_nm[0],
            "samples": len(group), "limit_nm": sizes.limit_nm, "limit_failures": sizes.limit_failures,
            "implausible_nm": criterion.implausible_nm,
        }  # fmt: skip

    def magnitudes(group, exposure_s, key):
        curve = curve_of_all(group, key)
        columns = zip(*(getattr(curve, name).tolist() for name in names), strict=True)
        return [dict(zip(names, column, strict=True)) for column in columns]

    by = ["exposure_s", "key"]
    return {"curves": ex.grouped(rows, by, limit), "magnitudes": ex.grouped(rows, by, magnitudes)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """No limit without NCPAs, three modes not before nine (the paper's Sect. 6.3), theory met."""
    found = []
    for exposure_s, group in tables["curves"].groupby("exposure_s", sort=False):
        of, curves = f"{exposure_s:g} s", group.set_index("key")
        reached = int(np.isfinite(group.limit_mag[~group.calibrated]).sum())
        name = f"ways without NCPAs that meet the criterion, {of}"
        found.append(ex.check(name, reached, f"{reached} of the uncalibrated ways", high=0))
        for kind in LABELS:
            three, nine = curves.loc[f"{kind}_3"], curves.loc[f"{kind}_9"]
            if nine.calibrated:
                name = f"magnitudes that three modes reach further than nine, {kind}, {of}"
                text = f"m_J {three.limit_mag:.1f} and {nine.limit_mag:.1f}"
                found.append(ex.check(name, three.limit_mag - nine.limit_mag, text, low=0.0, unit="mag"))
        default = curves.loc["default_3"]
        theory_nm = math.hypot(default.residual_floor_nm, MEDIAN_OF_NORMAL * default.bright_crb_nm)
        text = f"median {default.bright_error_nm:.1f} nm, theory {theory_nm:.1f} nm"
        name = f"error of the brightest star over theory, default, {of}"
        found.append(ex.check(name, default.bright_error_nm / theory_nm, text, high=OVER_THEORY))
    return found


LISTING = ex.Listing("curves", "Limiting magnitude",
    {"estimate": "{label}", "modes": "{modes}"},
    {
        "limit at {exposure_s:g} s [J mag]": "{limit_mag:.1f}",
        "bound at {exposure_s:g} s, one read [J mag]": "{one_read_bound_mag:.1f}",
        "error at the bright end, {exposure_s:g} s [nm]": "{bright_error_nm:.1f}",
    },
    caption="Faintest magnitude with median |error| ≤ {limit_nm:.0f} nm and ≤ {limit_failures:.0%} "
    "failures, of {trials} estimates per magnitude; –: met at no magnitude. Bound: an efficient estimate "
    "of frames of one read without sky.",
)  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Error and failures against magnitude, for every length of exposure."""
    found: ex.Blocks = []
    magnitudes = drawn.tables["magnitudes"]
    caption = (
        "Median |estimated − introduced defocus|. Circles, thick lines: three modes, with the 16th to 84th "
        f"percentile as a band and, dashed, the Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median error "
        "of an efficient estimate (dotted lines: of frames of one read without sky). Squares: nine "
        "modes. Dotted: a perfect sensor, which sees the mean defocus of the AO residual in every frame. "
        "Dash-dotted and vertical lines: criterion and limiting magnitudes."
    )
    for exposure_s, group in drawn.tables["curves"].groupby("exposure_s", sort=False):
        curves, looks = [], []
        for row in group.itertuples():
            own = magnitudes[(magnitudes.exposure_s == exposure_s) & (magnitudes.key == row.key)]
            columns = own.drop(columns=["exposure_s", "key"]).to_dict("list")
            kind = row.key.rpartition("_")[0]
            curve = CurveRow(**columns, trials=int(row.trials), limit_mag=row.limit_mag)
            curves.append((f"{LABELS[kind]}, {row.modes} modes", curve))
            looks.append(Look(COLOURS[kind], "o" if row.modes == 3 else "s", main=row.modes == 3))
        level = CriterionRow(median_abs_error_nm=row.limit_nm, failures=row.limit_failures)
        name = f"faint-{exposure_s:g}".replace(".", "-")
        drawing = sensitivity_plot(name, curves, level, looks, row.residual_floor_nm)
        found.append(ex.Figure(drawing, f"Exposures of {exposure_s:g} s", caption))
    return found


EXPERIMENT = ex.Experiment(
    "faint", 10, Sizes, "Sensitivity, simulated",
    samples, rows, tables, checks, [LISTING], figures,
    "Frames of the narrow H band dimmed to fainter stars, {samples} sets of NCPAs.", "samples",
)  # fmt: skip
