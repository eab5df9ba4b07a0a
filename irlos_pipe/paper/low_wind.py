"""How large a low-wind effect a calibration stands, with and without it in the model.

The petals of the pupil are displaced by pistons of a random pattern; the calibration of a cube has piston,
tip and tilt of every petal among its parameters, or knows nothing of petals. All cubes of a sample have the
same NCPAs and the same pattern; they differ in the size of the pattern, in band and in exposure.
"""

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.effects.pupil_steps import LowWindEffect
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.optics.wavefront import modes_at
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT, VARIANTS, ObservedCube
from irlos_pipe.paper.common.calibrations import weighted_rms as rms
from irlos_pipe.paper.common.observation import conditions_of
from irlos_pipe.paper.common.scenes import BY_MIRROR, COADDED, FINE, J_AND_H
from irlos_pipe.simulate.aperture import petal_count, petal_index
from irlos_pipe.simulate.scene import Scene

PATTERN_STREAM = 4  # child of a sample's seed that the pistons are drawn from
WITHOUT, WITH = "without", "with"
NARROW, BROAD = "narrow H", "J+H"
ASKED_NM = 10.0  # requirement on a calibration that has the petals in its model


class Sizes(ex.StageConfig):
    samples: int = Field(2, ge=1, le=1000, description="sets of NCPAs and patterns of petals")
    sizes_nm: tuple[float, ...] = Field(
        (0.0, 100.0, 200.0, 400.0), min_length=1, description="pistons [nm RMS over the petals]"
    )
    short_s: float = Field(0.1, gt=0, le=10, description="exposure of short frames [s]")
    long_s: float = Field(1.0, gt=0, le=10, description="exposure of long frames [s]")
    total_s: float = Field(10.0, gt=0, description="exposure of a whole cube [s]")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> ex.Samples:
    """One set of NCPAs and one pattern of petals, in cubes of all sizes of the pattern."""
    return ex.each(ctx, ctx.config.samples, "petals {index}")


def rows(petals: ex.Sample) -> ex.Rows:
    """Simulate all cubes of a sample and calibrate each without and with the petals in the model."""
    sizes, shape = petals.sizes, pattern(petals.seed, petals.facility)
    for band, exposure_s in ((NARROW, sizes.short_s), (NARROW, sizes.long_s), (BROAD, sizes.short_s)):
        for size_nm in sizes.sizes_nm:
            cube = ObservedCube.of(scene(petals, band, exposure_s, size_nm * shape))
            petals_in_model = [LowWindEffect.under(conditions_of(cube.scene))]
            for model, further in ((WITHOUT, []), (WITH, petals_in_model)):
                calibration = cube.calibrated(VARIANTS[DEFAULT], further)
                left_nm, petal, weight = left_of(cube, calibration)
                pupil_nm = rms(left_nm, weight)
                folded_nm = rms(folded(left_nm, petal, weight, cube.scene.bands[-1].centre_nm), weight)
                yield {
                    "recording": f"{band}, {exposure_s:g} s",
                    "size_nm": size_nm,
                    "model": model,
                    "largest_difference_nm": size_nm * float(np.ptp(shape)),
                    "introduced_nm": cube.introduced_wfe_nm(),
                    "pupil_nm": pupil_nm,
                    "folded_nm": folded_nm,  # every petal may be whole waves off, which one band cannot show
                    "modes_nm": rms(in_reported_modes(cube, calibration, left_nm), weight),
                    "chi2_nu": calibration.chi2_nu,
                    "judged_nm": folded_nm if band == NARROW else pupil_nm,
                }


def pattern(seed: tuple[int, ...], facility: Facility) -> np.ndarray:
    """Return the pistons of the petals, (petals,), of RMS 1 about a mean of 0."""
    drawn = np.random.default_rng([*seed, PATTERN_STREAM]).standard_normal(petal_count(facility.pupil))
    drawn -= drawn.mean()
    return drawn / np.sqrt(np.mean(drawn**2))


def scene(petals: ex.Sample, band: str, exposure_s: float, piston_nm: np.ndarray) -> Scene:
    """Return a cube through the narrow filter by the mirror, or in both broad bands through the lens."""
    sizes, light = petals.sizes, {"bands": J_AND_H, "throughput": 1.0}
    return petals.cube(
        sizes.seeing_arcsec,
        max(2, round(sizes.total_s / exposure_s)),
        sizes.mag_j,
        exposure_s=exposure_s,
        frame_rate_hz=min(10.0, 1 / exposure_s),
        sampling=FINE,
        effects={"low_wind_effect": {"piston_nm": piston_nm.tolist()}} if piston_nm.any() else {},
        detector=COADDED,
        **(BY_MIRROR if band == NARROW else light),
    )


def left_of(cube: ObservedCube, calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a calibration leaves of the wavefront of a cube, (points,) at the lit points of the pupil.

    Three arrays: true minus estimated wavefront [nm], the number of the petal, and the transmission.
    """
    exposed, geometry = cube.exposed, cube.scene.geometry
    lit, u_m = exposed.transmission > 0, exposed.telescope.u_m
    x_m, y_m = (np.broadcast_to(one, lit.shape)[lit] for one in (u_m[None, :], u_m[:, None]))
    petal = petal_index(geometry, x_m, y_m)
    estimated_nm = calibration.fitted_modes_nm @ modes_at(calibration.nolls, lit)
    steps = calibration.effects.get(LowWindEffect.name)
    if steps:
        piston, tip, tilt = (np.asarray(steps[f"{kind}_nm"]) for kind in ("piston", "tip", "tilt"))
        slope = 2 / (geometry.diameter_m / 2)
        estimated_nm = estimated_nm + piston[petal] + slope * (tip[petal] * x_m + tilt[petal] * y_m)
    return exposed.mean_opd_nm[lit] - estimated_nm, petal, exposed.transmission[lit]


def in_reported_modes(cube: ObservedCube, calibration: Calibration, left_nm: np.ndarray) -> np.ndarray:
    """Return the part of `left_nm`, (points,), in Noll 2–30, fitted jointly with all other calibrated modes.

    Petals are no polynomials: fitted alone, these modes would take over what petals have beyond them.
    """
    telescope, lit = cube.exposed.telescope, cube.exposed.transmission > 0
    on_grid_nm = np.zeros(lit.shape)
    on_grid_nm[lit] = left_nm
    found_nm = telescope.fit_zernike_nm(on_grid_nm, max(calibration.nolls))
    return found_nm[: len(REPORTED_NOLLS)] @ modes_at(REPORTED_NOLLS, lit)


def folded(values_nm: np.ndarray, petal: np.ndarray, weight: np.ndarray, wave_nm: float) -> np.ndarray:
    """Return a wavefront less the whole waves by which the mean of a petal is off that of the first."""
    chosen = [petal == one for one in range(petal.max() + 1)]
    means_nm = np.array([np.average(values_nm[own], weights=weight[own]) for own in chosen])
    return values_nm - wave_nm * np.round((means_nm - means_nm[0]) / wave_nm)[petal]


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Medians over the patterns, and the worst of them, which has a limit with petals in the model."""

    def summary(group, recording, size_nm, model):
        medians = ex.spreads(
            group, "largest_difference_nm", "introduced_nm", "pupil_nm", "folded_nm", "modes_nm", "chi2_nu"
        )
        asked_nm = ASKED_NM if model == WITH else None
        return medians | {"asked_nm": asked_nm, "worst_nm": group.judged_nm.max(), "samples": len(group)}

    return {"rows": ex.grouped(rows, ["recording", "size_nm", "model"], summary)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """What is left of the wavefront, where a limit is asked."""
    rows = tables["rows"].dropna(subset="asked_nm")
    narrow = rows.recording.str.startswith(NARROW)
    return ex.checked(
        rows.assign(waves=narrow.map({True: ", whole waves of a petal apart", False: ""})),
        "wavefront left with petals in the model, {recording}, {size_nm:g} nm", "worst_nm",
        "{worst_nm:.1f} nm RMS in the worst cube{waves}, asked {asked_nm:g} nm", high="asked_nm", unit="nm",
    )  # fmt: skip


LISTING = ex.Listing("rows", "Sizes of the effect",
    {
        "cube": "{recording}", "pistons [nm RMS]": "{size_nm:.0f}",
        "largest difference [nm]": "{largest_difference_nm:.0f}", "petals in the model": "{model}",
        "left [nm RMS]": "{pupil_nm:.1f}", "left, whole waves apart": "{folded_nm:.1f}",
        "worst cube": "{worst_nm:.1f}", "χ²/ν": "{chi2_nu:.1f}",
    },
    caption="RMS over the pupil of true minus estimated wavefront, medians over {samples} patterns; "
    'worst: whole waves apart in narrow H, as it is in J+H. 10 s of light, m_J 7, 0.5".',
    limit=("worst_nm", "asked_nm"),
)  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """What is left, whole waves of a petal apart."""
    table = drawn.tables["rows"].assign(line=lambda one: one.recording + ", " + one.model)
    return [ex.lines(
        "low-wind-left", "What is left of the wavefront",
        "Medians, whole waves of H of a petal apart; dotted: what is asked with petals in the model.",
        table, "size_nm", "folded_nm", colour="line", levels=[ASKED_NM],
        labels=("pistons [nm RMS over the petals]", "left [nm RMS]"),
    )]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "low_wind", 5, Sizes, "Low-wind effect: petals out of step",
    samples, rows, tables, checks, [LISTING], figures,
    "{samples} patterns of petals, calibrated without and with petals in the model.", "patterns of petals",
)  # fmt: skip
