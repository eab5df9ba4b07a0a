"""Calibrated ramps whose light has what the calibration in a narrow band could not show.

The pair is the real one: a cube through the narrow filter with the astigmatism of the mirror, and ramps in
J and H through the lens. All ramps of a sample have the same NCPAs, AO residual and stream of noise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.effects import Effect
from irlos_pipe.effects.colour import AtmosphericDispersion
from irlos_pipe.effects.wavefront import ChromaticNcpa, FilterNcpa
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import ramps
from irlos_pipe.paper.common.calibrations import DEFAULT
from irlos_pipe.paper.common.observation import conditions_of, settings_of
from irlos_pipe.paper.common.scenes import BY_MIRROR, FINE
from irlos_pipe.simulate.scene import Scene, draw_ncpa_nm
from irlos_pipe.stages.model.effects import star_colour

CHROMATIC_STREAM, FILTER_STREAM = 2, 3  # children of a sample's seed, next to that of the ramp
WAVEFRONT_MODES = 50  # as many as the NCPAs have
HELD_NM = 1e-3  # width of a prior that fixes a parameter
ASKED_NM = 4.0

BOTH_FRONTS: dict[str, Any] = {"chromatic_nm": 60.0, "filter_nm": 30.0}
# The slope of the star's photons is relative, beyond that which is assumed [1/µm].
REDDER, BLUER = {"spectrum": {"slope": 0.5}}, {"spectrum": {"slope": -0.5}}
NARROW_EXPOSURE_S, NARROW_MAG_J = 0.1, 7.1  # exposure and star of the paper's second ramp on sky


@dataclass(frozen=True)
class Way(ramps.LiftVariant):
    """One way to estimate a ramp, with AO residual and jitter as calibrated or expected.

    With `colour`, dispersion and the slope of the star's spectrum are fitted to all frames together, and up
    to `last_noll` the wavefront of the lens and the one that changes with wavelength. `tilt` of every frame
    is estimated, or held.
    """

    ncpa: str = DEFAULT
    colour: bool = True
    last_noll: int = 0
    tilt: Literal["free", "calibrated", "centroid"] = "free"


WAYS = {
    "default": Way("default: dispersion and colour fitted"),
    "wavefronts": Way("chromatic and lens's wavefront fitted too, to Noll 66", last_noll=66),
    "low_wavefronts": Way("the same, to Noll 21", last_noll=21),
    "plain": Way("neither dispersion nor colour", colour=False),
    "nine": Way("default, nine modes", ramps.NINE),
    "astigmatism": Way("default, Noll 6 free", (*ramps.TTF, 6)),
    "nine_astigmatism": Way("default, nine modes and Noll 6", tuple(sorted((*ramps.NINE, 6)))),
    "tilt_calibrated": Way("default, tip and tilt as calibrated", tilt="calibrated"),
    "tilt_centroid": Way("default, tip and tilt of the centroid", tilt="centroid"),
    "plain_nine": Way("nine modes", ramps.NINE, colour=False),
    "uncalibrated": Way("without NCPAs", ncpa="", colour=False),
    "uncalibrated_nine": Way("without NCPAs, nine modes", ramps.NINE, ncpa="", colour=False),
}


@dataclass(frozen=True)
class Condition:
    """What is true of a ramp and of no calibration in a narrow band, and the ways in which it is estimated.

    `effects` are those of the simulator; `chromatic_nm` is the wavefront between the centres of J and H,
    `filter_nm` that of the lens of the ramp [nm RMS]. `asked_nm` is the error of the defocus asked of the
    first way. A ramp in ``narrow H`` is by the mirror.
    """

    label: str
    ways: tuple[str, ...]
    asked_nm: float | None = ASKED_NM
    bands: Literal["J+H", "narrow H"] = "J+H"
    chromatic_nm: float = 0.0
    filter_nm: float = 0.0
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def dispersion(mas_per_um: float, angle_deg: float) -> dict[str, dict[str, float]]:
    return {"atmospheric_dispersion": {"mas_per_um": mas_per_um, "angle_deg": angle_deg}}


COLOURS, FRONTS, NARROW_WAYS = ("default", "plain"), ("wavefronts", "default"), ("plain", *list(WAYS)[-3:])
CONDITIONS = {
    "clean": Condition("nothing", ("default", "plain", "wavefronts", *list(WAYS)[4:9], *list(WAYS)[-2:])),
    "chromatic_30": Condition("chromatic NCPAs of 30 nm", FRONTS, chromatic_nm=30.0),
    "chromatic_60": Condition("chromatic NCPAs of 60 nm", FRONTS, chromatic_nm=60.0),
    "filter_30": Condition("lens of 30 nm", FRONTS, filter_nm=30.0),
    "chromatic_60_filter_30": Condition(
        "chromatic NCPAs of 60 nm, lens of 30 nm", ("wavefronts", "low_wavefronts", "default"), **BOTH_FRONTS
    ),
    **{
        f"dispersion_{size}_at_{angle}": Condition(
            f"dispersion of {size} mas/µm at {angle}°", COLOURS, effects=dispersion(size, angle)
        )
        for size, angle in ((50, 0), (50, 45), (100, 0), (100, 45), (100, 90))
    },
    "redder": Condition("star redder by 0.5 per µm", COLOURS, effects=REDDER),
    "bluer": Condition("star bluer by 0.5 per µm", COLOURS, effects=BLUER),
    "all": Condition(
        "60 nm chromatic, lens 30 nm, 100 mas/µm at 45°, redder", FRONTS, **BOTH_FRONTS,
        effects=dispersion(100.0, 45.0) | REDDER,
    ),
    "narrow_h": Condition("narrow H alone, 0.1 s, by the mirror", NARROW_WAYS, None, "narrow H"),
}  # fmt: skip


def effects_of(
    condition: Condition, seed: tuple[int, ...], facility: Facility
) -> dict[str, Mapping[str, Any]]:
    """Return the simulator's effects of a condition, by name."""

    def drawn_nm(stream: int, first: int, total_nm: float) -> dict[int, float]:
        """A wavefront by the law of the NCPAs from Noll `first` on, of `total_nm` RMS.

        Tip and tilt of the colours are dispersion, and the focus of a lens is that of the star.
        """
        rng = np.random.default_rng((*seed, stream))
        drawn = draw_ncpa_nm(rng, facility.ncpa_law, 1.0, WAVEFRONT_MODES)
        kept = {noll: value for noll, value in drawn.items() if noll >= first}
        norm = float(np.linalg.norm(list(kept.values())))
        return {noll: value * total_nm / norm for noll, value in kept.items()}

    found: dict[str, Any] = {}
    if condition.chromatic_nm:
        per_um = condition.chromatic_nm / (bands.H.centre_nm - bands.J.centre_nm) * 1e3
        slopes = drawn_nm(CHROMATIC_STREAM, DEFOCUS, per_um)
        found["chromatic_ncpa"] = {"zernike_nm_per_um": slopes, "reference_nm": bands.NARROW_H.centre_nm}
    if condition.filter_nm:
        found["filter_ncpa"] = {"zernike_nm": drawn_nm(FILTER_STREAM, DEFOCUS + 1, condition.filter_nm)}
    return found | dict(condition.effects)


def fit_way(ramp: ramps.ObservedRamp, way: Way) -> RampFit:
    """Estimate all frames of a ramp in one way, with the model and the sampling of the stage `lift`."""
    model = PsfModel(settings_of(ramp.scene, ramp.given_nm(way)).for_single_frames(), way.modes)
    start_nm = ramp.start_nm(way, model)
    options = LiftOptions()
    if way.tilt != "free":
        sigma_nm = torch.full((len(way.modes),), torch.inf, dtype=torch.float64)
        mean_nm = start_nm.clone()
        for place in map(way.modes.index, TIP_TILT):
            sigma_nm[place] = HELD_NM
            if way.tilt == "calibrated":
                mean_nm[:, place] = 0.0
        options = replace(options, prior_mean_nm=mean_nm, prior_sigma_nm=sigma_nm)
    effects = ramp.effects(way) + _of_light(ramp.scene, way)
    return fit_ramp(model, ramp.data, start_nm, options, effects)


def _of_light(scene: Scene, way: Way) -> list[Effect]:
    """What a way fits to the whole ramp."""
    conditions = conditions_of(scene, ncpa_wavelength_nm=bands.NARROW_H.centre_nm)
    colour = [AtmosphericDispersion.under(conditions), star_colour(conditions)] if way.colour else []
    if not way.last_noll:
        return colour
    chromatic, lens = (range(first, way.last_noll + 1) for first in (DEFOCUS, DEFOCUS + 1))
    return [*colour, ChromaticNcpa.under(conditions, chromatic), FilterNcpa.under(conditions, lens)]


class Sizes(ramps.RampSizes):
    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs")
    conditions: Annotated[tuple[str, ...], ex.known(CONDITIONS, "condition")] = Field(
        tuple(CONDITIONS), min_length=1, description="what the light of the ramps has"
    )


def samples(ctx: ex.Context) -> ex.Samples:
    """One set of NCPAs each: a cube to calibrate them, and a ramp under every condition."""
    return ex.each(ctx, ctx.config.samples, "NCPAs {index}")


def rows(star: ex.Sample) -> ex.Rows:
    """Estimate every ramp in every way of its condition."""
    cube = cube_of(star)
    knowledge = ramps.calibrated(cube, [DEFAULT])
    for key in star.sizes.conditions:
        condition = CONDITIONS[key]
        observed = ramps.observe(ramp_of(cube, condition, star.sizes), knowledge)
        for name in condition.ways:
            way = WAYS[name]
            fit = fit_way(observed, way)
            there_nm = observed.true_nm[:, [noll - 2 for noll in way.modes]]
            modes_nm = there_nm, observed.modes_nm(way, fit), observed.given_nm(way).get(DEFOCUS, 0.0)
            yield {
                "condition": key,
                "way": name,
                **mode_errors(way.modes, observed.data.introduced_nm, *modes_nm),
                "sigma_nm": np.nanmedian(fit.result.sigma_nm.numpy(), axis=0),
                "converged": float(np.mean(fit.result.solution.converged.numpy())),
            }


def cube_of(star: ex.Sample) -> Scene:
    """Return the calibration cube, through the narrow filter by the mirror."""
    return star.cube(*star.sizes.of_cube, sampling=FINE, **BY_MIRROR)


def ramp_of(cube: Scene, condition: Condition, sizes: Sizes) -> Scene:
    """Return the ramp under a condition, through the lens with frames of a second, or through the filter."""
    if condition.bands == "J+H":
        effects = effects_of(condition, cube.seed, cube.facility)
        return ramps.ramp_scene(cube, sizes.ramp_mag_j, sizes.introduced_nm, effects=effects)
    return replace(ramps.narrow_ramp(cube, NARROW_EXPOSURE_S, sizes.introduced_nm), mag_j=NARROW_MAG_J)


def mode_errors(
    modes: tuple[int, ...],
    introduced_nm: np.ndarray,
    true_nm: np.ndarray,
    modes_nm: np.ndarray,
    given_nm: float,
) -> dict[str, Any]:
    """Return the errors of estimates `modes_nm`, (frames, modes), of `true_nm`; `given_nm` of the defocus.

    ``rms_nm`` is that of the defocus against the introduced one and the NCPA given to the estimator,
    ``true_rms_nm`` and ``bias_nm`` are those against the defocus that was in the frame. Of every mode,
    (modes,), there are the RMS error ``mode_nm``; ``scatter_nm`` of the estimates and ``true_scatter_nm`` of
    the truth over the frames, without what is linear in the introduced defocus; and the ``leak`` of the
    introduced defocus into it (defocus itself: 1 less).
    """
    focus, wrong_nm = modes.index(DEFOCUS), modes_nm - true_nm
    slope, rest_nm = _line(introduced_nm, modes_nm)
    return {
        "rms_nm": _rms(modes_nm[:, focus] - given_nm - introduced_nm),
        "true_rms_nm": _rms(wrong_nm[:, focus]),
        "bias_nm": float(np.nanmean(wrong_nm[:, focus])),
        "mode_nm": np.array([_rms(column) for column in wrong_nm.T]),
        "scatter_nm": np.nanstd(rest_nm, axis=0),
        "true_scatter_nm": np.nanstd(_line(introduced_nm, true_nm)[1], axis=0),
        "leak": slope - np.array([noll == DEFOCUS for noll in modes]),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _line(introduced_nm: np.ndarray, modes_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope of every mode against the introduced defocus, (modes,), and what is left, (frames, modes)."""
    usable = np.isfinite(modes_nm).all(axis=1)
    slope, offset_nm = np.polyfit(introduced_nm[usable], modes_nm[usable], 1)
    return slope, modes_nm - np.outer(introduced_nm, slope) - offset_nm


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """RMS over the ramps of every way under every condition, and of all modes."""

    def summary(group, key, way):
        condition = CONDITIONS[key]
        found = {
            "condition_label": condition.label,
            "label": WAYS[way].name,
            "samples": len(group),
            "converged": group.converged.min(),
            "asked_nm": condition.asked_nm if way == condition.ways[0] else None,
        }
        for name in ("rms_nm", "true_rms_nm", "bias_nm"):
            found |= ex.rms_in_range(name, group[name])
        return found

    def modes(group, key, way):
        for place, noll in enumerate(WAYS[way].modes):
            error_nm = ex.rms_in_range("error_nm", [one[place] for one in group.mode_nm])
            others = {
                name: float(np.sqrt(np.mean([one[place] ** 2 for one in group[name]])))
                for name in ("sigma_nm", "scatter_nm", "true_scatter_nm", "leak")
            }
            yield {"noll": noll} | error_nm | others

    by = ["condition", "way"]
    return {"ways": ex.grouped(rows, by, summary), "modes": ex.grouped(rows, by, modes)}


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The error of the defocus, where a limit is asked."""
    return ex.checked(
        tables["ways"].dropna(subset="asked_nm"), "defocus error, ramp with {condition_label}", "true_rms_nm",
        "{true_rms_nm:.1f} nm RMS (90 %: {true_rms_nm_low:.1f} to {true_rms_nm_high:.1f}), "
        "asked {asked_nm:g} nm", high="asked_nm", unit="nm",
    )  # fmt: skip


LISTINGS = [
    ex.Listing("ways", "Conditions and estimates",
        {
            "in the light of the ramp": "{condition_label}", "estimate": "{label}",
            "error of the defocus [nm RMS]": "{true_rms_nm:.1f}",
            "90 %": "{true_rms_nm_low:.1f}–{true_rms_nm_high:.1f}", "mean of a ramp [nm]": "{bias_nm:.1f}",
            "against the introduced defocus [nm RMS]": "{rms_nm:.1f}",
        },
        caption="RMS over all frames of {samples} ramps, against the defocus there was in every frame at "
        "the wavelength of the calibration; last column: against the introduced defocus alone, so that "
        "the AO residual's own defocus counts as an error and, without NCPAs, theirs as well. Ranges of "
        'three samples hold the truth in some 75 %. −300…300 nm, m_J 12, 1 s, 0.35".',
        limit=("true_rms_nm", "asked_nm"),
    ),
    ex.Listing("modes", "All modes of a ramp",
        {
            "ramp": "{condition}, {way}", "Noll": "{noll}",
            "error [nm RMS]": "{error_nm:.1f} ({error_nm_low:.1f}–{error_nm_high:.1f})",
            "quoted, photon noise [nm]": "{sigma_nm:.2f}", "scatter [nm RMS]": "{scatter_nm:.1f}",
            "scatter there was [nm RMS]": "{true_scatter_nm:.1f}",
            "of the introduced defocus": "{leak:.4f}",
        },
        where="noll > 3 and condition in ['clean', 'narrow_h'] and way in ['nine', 'nine_astigmatism', "
        "'uncalibrated_nine', 'plain_nine']",
        caption="Scatter over the frames of a ramp, beside what goes with the introduced defocus, of the "
        "estimate and of the mode there was; last column: the part of the introduced defocus that goes "
        "into the mode, of defocus itself slope minus 1.",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    rows = drawn.rows()
    pairs = zip(rows.condition, rows.way, strict=True)
    rows["named"] = [f"{CONDITIONS[key].label}; {WAYS[way].name}" for key, way in pairs]
    return [ex.strips(
        "ramp-conditions-errors", "Error of the defocus of every ramp",
        "Every point is a ramp; bars: medians; dotted: what is asked of the first estimate.",
        rows, {"true_rms_nm": "error of a ramp"}, by="named", label="error of the defocus [nm RMS]",
        levels=[ASKED_NM], inches=10.5, width="full",
    )]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "ramp_conditions", 4, Sizes, "Ramps with colours, filters and dispersion",
    samples, rows, tables, checks, LISTINGS, figures,
    "{samples} sets of NCPAs, calibrated in narrow H by the mirror.", "sets of NCPAs",
)  # fmt: skip
