"""The derotator test (paper, Sect. 6.1) with known truth: cubes at several angles of the derotator.

Random NCPAs and the phase bump lie before the derotator, other NCPAs behind it; the estimates of every angle
are split into what turns and what does not.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.estimate.derotator import Series, Split, try_both_senses, usable_modes
from irlos_pipe.optics.zernike import partner, rotation_matrix, zernike_basis
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import calibrations
from irlos_pipe.paper.common.observation import on_spartas_scale
from irlos_pipe.paper.common.scenes import BY_MIRROR
from irlos_pipe.report.images import common_limit_nm, wavefront_grid
from irlos_pipe.report.section_series import maps_figure
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import Sampling, Scene, draw_ncpa_nm
from irlos_pipe.stages.derotator import SplitOutput, map_of

PEAK_NM = 1140.0
CENTRE = (0.145, 0.901)  # x, y [pupil radii]
LENGTH, WIDTH = 0.546, 0.154  # standard deviations along and across [pupil radii]
DIRECTION_DEG = 42.6  # of the ridge, from +x towards +y
RADII, AZIMUTHS = 200, 360  # grid of points of equal area

LARGEST_PULL = 1.5  # requirement on the error over the quoted error
PARTS = {"rotating": "turns with the derotator", "fixed": "does not turn"}


def ridge_nm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of the bump at the points `x`, `y` of the unit disc [nm]."""
    angle = np.radians(DIRECTION_DEG)
    dx, dy = x - CENTRE[0], y - CENTRE[1]
    along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    return PEAK_NM * np.exp(-(along**2) / (2 * LENGTH**2) - across**2 / (2 * WIDTH**2))


def phase_bump_nm(highest_noll: int = 120) -> dict[int, float]:
    """Return the coefficients of the bump over the disc, Noll 4 to `highest_noll`: nm RMS."""
    radius = np.sqrt((np.arange(RADII) + 0.5) / RADII)[:, None]
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    x, y = (radius * np.cos(azimuth)).ravel(), (radius * np.sin(azimuth)).ravel()
    basis = zernike_basis(range(1, highest_noll + 1), x, y)
    values = np.linalg.lstsq(basis.T, ridge_nm(x, y), rcond=None)[0]
    return {noll: float(value) for noll, value in enumerate(values, start=1) if noll > 3}


class Sizes(ex.StageConfig):
    angles_deg: tuple[float, ...] = Field(
        (0, 23, 46, 69, 92, 115, 138, 161, 180), min_length=2, description="derotator angles"
    )
    frames: int = Field(600, ge=10, le=10000, description="frames of a cube")
    published_frames: calibrations.PublishedFrames = 100
    seeing_arcsec: float = Field(1.2, gt=0, le=5, description="seeing by MASS-DIMM, as the paper has it")
    mag_j: float = Field(8.0, ge=0, le=20, description="J magnitude of the star")
    rotating_nm: float = Field(50.0, ge=0, description="random NCPAs before the derotator, beside the bump")
    fixed_nm: float = Field(100.0, ge=0, description="random NCPAs behind it")


@dataclass(frozen=True)
class Truth:
    """The static wavefront before the derotator, at angle 0, and behind it, Noll: nm RMS."""

    rotating_nm: Mapping[int, float]
    fixed_nm: Mapping[int, float]

    def at(self, nolls: Sequence[int], angle_deg: float) -> np.ndarray:
        """Return the coefficients of the modes `nolls` at derotator angle `angle_deg`, (modes,) [nm]."""
        every = sorted({other for noll in (*nolls, *self.rotating_nm) for other in (noll, partner(noll))})
        turned = rotation_matrix(every, angle_deg) @ _values(self.rotating_nm, every)
        return _values(dict(zip(every, turned, strict=True)), nolls) + _values(self.fixed_nm, nolls)


def draw_truth(seed: Sequence[int], law: NcpaLaw, rotating_nm: float, fixed_nm: float) -> Truth:
    """Draw random NCPAs of these RMS on either side of the derotator and add the phase bump before it."""
    rng = np.random.default_rng(seed)
    before, behind = (draw_ncpa_nm(rng, law, total_nm) for total_nm in (rotating_nm, fixed_nm))
    bump = phase_bump_nm()
    together = {noll: before.get(noll, 0.0) + bump.get(noll, 0.0) for noll in sorted({*before, *bump})}
    return Truth(together, behind)


def truth_of(ctx: ex.Context) -> Truth:
    law = ctx.instrument.facility.ncpa_law
    return draw_truth((ctx.seed,), law, ctx.config.rotating_nm, ctx.config.fixed_nm)


def samples(ctx: ex.Context) -> ex.Samples:
    """The cube of one angle each, at the seeing on SPARTA's scale."""
    truth, seeing = truth_of(ctx), on_spartas_scale(ctx.instrument, ctx.config.seeing_arcsec)
    for index, angle in enumerate(ctx.config.angles_deg):
        yield ex.sample(ctx, f"{angle:g} deg", 1, index, angle_deg=angle, sparta_arcsec=seeing, truth=truth)


def rows(star: ex.Sample) -> ex.Rows:
    """Simulate one cube and calibrate it by both methods, each with its number of frames."""
    cube = calibrations.ObservedCube.of(scene_of(star))
    frames = calibrations.frames_per_method(star.sizes.frames, star.sizes.published_frames)
    for method, count in frames.items():
        own = cube.first(count)
        fit = own.calibrated(calibrations.VARIANTS[method].closed())
        yield {
            "method": method,
            "frames": count,
            "delta_nm": own.modes_delta_nm(fit),
            "chi2_nu": fit.chi2_nu,
            "nolls": np.array(fit.nolls),
            "zernike_nm": fit.zernike_nm,
            "covariance_nm2": fit.covariance_nm2,
            "mean_image_e": cube.frames.mean_e.numpy(),
        }


def scene_of(star: ex.Sample) -> Scene:
    """Return the recording of one angle: a cube with diversity by the deformable mirror."""
    truth, of_cube = star["truth"], (star["sparta_arcsec"], star.sizes.frames, star.sizes.mag_j)
    return star.cube(
        *of_cube,
        role="derotator",
        ncpa_nm=truth.fixed_nm,
        rotating_nm=truth.rotating_nm,
        derotator_angle_deg=star["angle_deg"],
        motion=Motion(),
        detector=DetectorModel(),
        sampling=Sampling(),
        **BY_MIRROR,
    )


def splits(rows: ex.Frame) -> dict[str, SplitOutput]:
    """Return the estimates of every method split into what turns and what does not."""
    found = {}
    for method, own in rows.groupby("method", sort=False):
        nolls, angles_deg = tuple(own.nolls.iloc[0].tolist()), own.angle_deg.to_numpy(float)
        stacks = ex.stacked(own, "zernike_nm", "covariance_nm2")
        series = Series(nolls, angles_deg, *stacks).only(usable_modes(nolls))
        found[method] = SplitOutput(series, *try_both_senses(series))
    return found


def split_errors(series: Series, split: Split, truth: Truth) -> dict[str, float]:
    """Compare the `split` of the estimates `series` with the simulated `truth`, RMS over the disc [nm].

    Of every part in Noll 4–30, among its modes; of the rotating part as a map, where modes that were not
    estimated count in full; of the estimates at single angles, and of what the parts predict for them.
    """
    reported = np.isin(split.nolls, REPORTED_NOLLS)
    apart, sums = reported & split.separable, reported & ~split.separable
    rotating, fixed = (_values(part, split.nolls) for part in (truth.rotating_nm, truth.fixed_nm))
    static = np.array([truth.at(split.nolls, angle) for angle in series.angles_deg])
    found = dict(zip(split.nolls, split.rotating.zernike_nm, strict=True))
    turning = [noll for noll in truth.rotating_nm if partner(noll) != noll and noll not in TIP_TILT]
    norms = {
        "rotating": (split.rotating.zernike_nm - rotating)[apart],
        "fixed": (split.fixed.zernike_nm - fixed)[apart],
        "unsplit": (split.unsplit.zernike_nm - rotating - fixed)[sums],
        "rotating_all": _values(found, turning) - _values(truth.rotating_nm, turning),
    }
    singles = {"single": series.zernike_nm - static, "model": split.predicted_nm - static}
    return {f"{name}_error_nm": float(np.linalg.norm(values)) for name, values in norms.items()} | {
        f"{name}_error_nm": float(np.sqrt(np.mean(np.sum(values[:, reported] ** 2, axis=1))))
        for name, values in singles.items()
    }


def rms_beyond_tilt_nm(zernike_nm: Mapping[int, float]) -> float:
    """Return the RMS over the disc without tip and tilt [nm]."""
    return float(np.sqrt(sum(value**2 for noll, value in zernike_nm.items() if noll not in TIP_TILT)))


def _values(given_nm: Mapping[int, float], nolls: Sequence[int]) -> np.ndarray:
    return np.array([given_nm.get(noll, 0.0) for noll in nolls])


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """The split of every method against the truth, its parts mode by mode, and every angle."""
    truth, found = truth_of(ctx), splits(rows)
    results = {method: split.results() for method, split in found.items()}
    in_all = {f"truth_{part}_nm": rms_beyond_tilt_nm(getattr(truth, f"{part}_nm")) for part in PARTS}

    def errors(group, method):
        split, result = found[method], results[method]
        return {
            "label": calibrations.METHOD_NAMES[method], "frames": int(group.frames.iloc[0]), **in_all,
            **{name: result[name] for name in ("sense", "delta_chi2", "chi2_nu", "freedom")},
            **asdict(result["consistency"]),
            **split_errors(split.series, split.split, truth),
        }  # fmt: skip

    def parts(group, method):
        for part, row in results[method]["parts"].items():
            yield {"part": part, "rms_nm": row.rms_nm, "noise_nm": row.noise_nm}

    def modes(group, method):
        for part, row in results[method]["parts"].items():
            for noll, value_nm in row.zernike_nm.items():
                numbers = {"zernike_nm": value_nm, "sigma_nm": row.sigma_nm[noll]}
                yield {"part": part, "noll": noll, **numbers}

    def angles(group, method):
        measured = {name: results[method][name] for name in ("measured_nm", "residual_nm")}
        columns = group[["angle_deg", "delta_nm", "chi2_nu"]]
        return columns.assign(**measured, label=calibrations.METHOD_NAMES[method]).to_dict("records")

    tables = {"methods": errors, "parts": parts, "angles": angles, "modes": modes}
    return {name: ex.grouped(rows, ["method"], summary) for name, summary in tables.items()}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default's parts err as quoted."""
    modes = tables["modes"].query(f"method == '{calibrations.DEFAULT}' and noll <= {HIGHEST_REPORTED_NOLL}")
    default, found = tables["methods"].query(f"method == '{calibrations.DEFAULT}'").iloc[0], []
    for part in PARTS:
        quoted_nm, error_nm = math.hypot(*modes.sigma_nm[modes.part == part]), default[f"{part}_error_nm"]
        pull = error_nm / quoted_nm if quoted_nm > 0 else math.nan
        text = f"{error_nm:.1f} nm where {quoted_nm:.1f} are quoted, Noll 4 to {HIGHEST_REPORTED_NOLL}"
        found.append(ex.check(f"error over quoted error, {part} part", pull, text, high=LARGEST_PULL))
    return found


LISTINGS = [
    ex.Listing("methods", "Errors",
        {
            "method": "{label}", "frames": "{frames}", "single angle": "{single_error_nm:.1f}",
            "two parts": "{model_error_nm:.1f}", "turning part": "{rotating_error_nm:.1f}",
            "fixed part": "{fixed_error_nm:.1f}", "symmetric modes": "{unsplit_error_nm:.1f}",
            "turning part, all modes": "{rotating_all_error_nm:.1f}",
        },
        caption="RMS over the disc against what was simulated [nm], Noll 4–30; the last column counts the "
        "modes that were not estimated. Single angle: estimates as they come; two parts: what the split "
        "predicts.",
    ),
    ex.Listing("methods", "Agreement of the angles",
        {
            "method": "{label}", "as measured": "{measured_nm:.1f}", "turned back": "{turned_back_nm:.1f}",
            "without the fixed part": "{without_fixed_nm:.1f}", "expected": "{expected_nm:.1f}",
            "χ²/ν of the split": "{chi2_nu:.2f}", "sense, Δχ² of the other": "{sense}, {delta_chi2:+.0f}",
        },
        caption="Mean RMS difference between two angles [nm]; expected: from the errors of the estimates.",
    ),
    ex.Listing("angles", "Angles one by one",
        {"angle": "{angle_deg:g}°"},
        {"{label} [nm]": "{delta_nm:.1f}"},
        caption="Δ-WFE in Noll 2–30 against the mean wavefront of the frames used, AO residual included.",
    ),
]  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """Images, and maps of the truth, of the estimates and of the parts."""
    pupil, truth, found = ctx.instrument.pupil, truth_of(ctx), {}
    for part in PARTS:
        seen = {noll: value for noll, value in getattr(truth, f"{part}_nm").items() if noll > 3}
        map_nm = map_of(pupil, list(seen), np.array(list(seen.values())))
        found[f"truth/maps/{part}_nm"] = ex.Quantity(map_nm, "nm", "simulated, without tip and tilt")
    (images,) = ex.stacked(rows[rows.method == calibrations.DEFAULT], "mean_image_e")
    found["mean_image_e"] = ex.Quantity(images, "e-", "of a frame")
    for method, split in splits(rows).items():
        found |= {f"{method}/{name}": quantity for name, quantity in split.arrays(pupil).items()}
    return found


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """Every angle by both methods, and both parts as simulated and as found."""
    methods = list(drawn.tables["methods"].method)
    found: ex.Blocks = []
    for method in methods:
        images = drawn.array("mean_image_e") if method == methods[0] else None
        title = f"Every angle, {calibrations.METHOD_NAMES[method]}"
        found += maps_figure(drawn.run, drawn.stage, title, images, prefix=f"{method}/")
    caption = (
        "Symmetric modes, of which only the sum of both parts is measured, are in the simulated map only."
    )
    sources = {"simulated": "truth"} | {calibrations.METHOD_NAMES[name]: name for name in methods}
    for part, text in PARTS.items():
        maps = np.stack([drawn.array(f"{source}/maps/{part}_nm") for source in sources.values()])
        drawing = wavefront_grid(f"series-{part}", list(sources), {"": maps}, common_limit_nm(maps[0]))
        found.append(ex.Figure(drawing, f"What {text}", caption))
    return found


EXPERIMENT = ex.Experiment(
    "derotator_series", 5, Sizes, "Derotator test, simulated",
    samples, rows, tables, checks, LISTINGS, figures,
    "{truth_rotating_nm:.0f} nm RMS with a phase bump before the derotator, {truth_fixed_nm:.0f} behind it.",
    "angles", arrays,
)  # fmt: skip
