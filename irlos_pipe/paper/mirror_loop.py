"""NCPAs corrected by a deformable mirror until nothing improves (paper, Sect. 6.1).

A cube of the star is calibrated, the mirror is sent minus the estimate, and the next cube is taken through
what the mirror made of it. The mirror is not the one that its control believes in: its gain is off, and its
actuators are shifted and turned against the pupil. The star was refocused before, or has a defocus bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, DEFOCUS, REPORTED_NOLLS
from irlos_pipe.effects import fixed_optics
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.correction import modal_offsets, predict_correction
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES, PAPER_CHOICE, VARIANTS, ObservedCube
from irlos_pipe.paper.common.mirror_bench import BY_MIRROR, EXACT, LEFT, Bench, MirrorErrors, further
from irlos_pipe.paper.common.ramps import knowledge_of
from irlos_pipe.paper.common.scenes import FINE, MIRROR_DIVERSITY_NM, star_image
from irlos_pipe.simulate.scene import Scene

IMPROVES = 0.9  # an estimate is applied where it is below this part of the one before
ASKED_NM = 10.0  # requirement on the default with the declared diversity, in Noll 4–30
LOOPS = ((DEFAULT, EXACT), (PAPER_CHOICE, EXACT), (DEFAULT, BY_MIRROR))
STATE = (*LEFT, "strehl", "seen_nm")


class Sizes(ex.StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs")
    biases_nm: tuple[float, ...] = Field(
        (0.0, 200.0, -200.0), min_length=1, description="defocus; 0 is a star that was refocused [nm RMS]"
    )
    frames: int = Field(60, ge=10, le=10000, description="frames of a cube")
    star_frames: int = Field(20, ge=1, le=10000, description="frames of 0.1 s averaged to a star's image")
    corrections: int = Field(6, ge=1, le=50, description="most corrections of a loop")
    pitches_m: tuple[float, ...] = Field(
        (0.22, 1.0), min_length=1, description="from actuator to actuator; the first is that of the loops [m]"
    )
    gain: float = Field(0.9, gt=0, lt=2, description="stroke of the mirror over the stroke asked for")
    shift: float = Field(0.03, ge=0, le=0.2, description="of the mirror, over the diameter of the pupil")
    turn_deg: float = Field(1.0, ge=-45, le=45, description="angle by which the mirror is turned [deg]")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def samples(ctx: ex.Context) -> ex.Samples:
    """One set of NCPAs with one bias of the defocus."""
    for bias_nm in ctx.config.biases_nm:
        yield from ex.each(ctx, ctx.config.samples, "bias {bias_nm:g} nm, NCPAs {index}", bias_nm=bias_nm)


def rows(star: ex.Sample) -> ex.Rows:
    """Close every loop on a star, and give every mirror the true wavefront."""
    sizes, scene = star.sizes, scene_of(star)
    errors, diameter_m = MirrorErrors(sizes.gain, sizes.shift, sizes.turn_deg), star.facility.pupil.diameter_m
    bench = Bench(scene, sizes.star_frames)
    ideal = star_image(scene, sizes.star_frames, {})[1]
    for method, diversity in LOOPS:
        loop = {"method": method, "diversity": diversity}
        mirror, seen_nm = errors.mirror(diameter_m, sizes.pitches_m[0]), []
        for done in range(sizes.corrections + 1):
            cube = ObservedCube.of(bench.cube(mirror, done, diversity))
            calibration = cube.calibrated(VARIANTS[method])
            estimate_nm = seen_by(calibration)
            seen_nm.append(float(np.linalg.norm([estimate_nm[noll] for noll in CORRECTED_NOLLS])))
            falling = improves(seen_nm)
            state = bench.left(mirror) | {"strehl": bench.strehl(mirror), "seen_nm": seen_nm[-1]}
            last = not falling or done == sizes.corrections
            yield {"what": "state", **loop, "corrections": done, **state, "last": last, "falling": falling}
            if done == 0:
                predicted = predicted_strehl(cube, calibration)
                yield {"what": "star", **loop, "predicted": predicted, "ideal": ideal}
            if last:
                break
            mirror = replace(mirror, offsets_nm=further(mirror.offsets_nm, estimate_nm))
        for cause, left in bench.causes(mirror, done, diversity).items():
            yield {"what": "cause", **loop, "cause": cause, **left}
    for pitch_m in sizes.pitches_m:
        for error, own in errors.alone().items():
            mirror = own.mirror(diameter_m, pitch_m)
            states = [bench.of(one) for one in bench.told(mirror, 0.0, sizes.corrections)]
            which = {"pitch_m": pitch_m, "actuators": int(mirror.actuators.present.sum()), "error": error}
            for done, left in enumerate(states):
                yield {"what": "alone", **which, "corrections": done, **left}


def scene_of(star: ex.Sample) -> Scene:
    """Return the cube before any correction."""
    cube = star.cube(star.sizes.seeing_arcsec, star.sizes.frames, star.sizes.mag_j)
    ncpa_nm = {**cube.ncpa_nm, DEFOCUS: star["bias_nm"]}
    return replace(
        cube, ncpa_nm=ncpa_nm, diversity_nm=MIRROR_DIVERSITY_NM, diversity_source="mirror", sampling=FINE
    )


def improves(seen_nm: Sequence[float]) -> bool:
    """Return whether the last of the estimates `seen_nm` is well below the one before."""
    return len(seen_nm) < 2 or bool(seen_nm[-1] < IMPROVES * seen_nm[-2])


def seen_by(calibration: Calibration) -> dict[int, float]:
    """Return minus the offsets that the stage `correct` makes of a `calibration`, Noll: nm RMS."""
    offsets = modal_offsets(
        calibration.nolls, calibration.zernike_nm, calibration.sigma_nm, 1.0, REPORTED_NOLLS[-1]
    )
    return dict(zip(offsets.nolls.tolist(), (-offsets.value_nm).tolist(), strict=True))


def predicted_strehl(cube: ObservedCube, calibration: Calibration) -> float:
    """Return the Strehl ratio that the stage `correct` predicts of the star after a full correction."""
    effects = list(knowledge_of(cube, calibration).effects.values())
    gain = np.isin(calibration.nolls, REPORTED_NOLLS).astype(float)
    modes = calibration.nolls, calibration.fitted_modes_nm, calibration.zernike_nm
    return predict_correction(
        cube.settings, *modes, gain, lambda model: fixed_optics(effects, model.grids)
    ).strehl_after


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """The loops, their wavefront after every correction, the causes of what is left, and mirrors alone."""
    kinds, loop = dict(list(rows.groupby("what", sort=False))), ["method", "diversity", "bias_nm"]
    states, stars = kinds["state"], kinds["star"].set_index([*loop, "sample"])
    places = [LOOPS.index(pair) for pair in zip(states.method, states.diversity, strict=True)]
    states = states.assign(loop=places).sort_values("loop", kind="stable")
    causes = ex.grouped(kinds["cause"], [*loop, "cause"], lambda group, *_: {
        name: float(np.median(group[name])) for name in ("modes_nm", "beyond_nm")
    })  # fmt: skip

    def loops(group, *key):
        first, last = group[group.corrections == 0], group[group["last"]]
        star, done = stars.loc[key], last.corrections.astype(int)
        after_one = group.modes_nm[group.corrections == 1]
        numbers = {
            "introduced_nm": first.all_nm, "before_nm": first.modes_nm, "strehl_before": first.strehl,
            "corrections": done, "end_nm": last.modes_nm, "beyond_nm": last.beyond_nm, "all_nm": last.all_nm,
            "strehl_end": last.strehl, "strehl_ideal": star.ideal, "strehl_predicted": star.predicted,
        }  # fmt: skip
        own = causes[(causes[loop] == list(key)).all(axis=1)]
        return {
            "samples": len(first),
            **dict(item for name, values in numbers.items() for item in ex.spread(name, values).items()),
            "after_one_nm": np.median(after_one) if len(after_one) else None,
            "most_corrections": done.max(),
            "cut_off": int(last.falling.sum()),  # the estimate still fell at the last correction allowed
            "limit": own.cause[own.modes_nm.idxmax()],
            "asked_nm": ASKED_NM if key[:2] == LOOPS[0] else None,
            "worst_nm": last.modes_nm.max(),
        }

    def alone(group, *_):
        steps = {
            f"modes_nm_{int(done)}": np.median(own) for done, own in group.groupby("corrections").modes_nm
        }
        return steps | {"beyond_nm": np.median(group.beyond_nm[group.corrections == group.corrections.max()])}

    by_step = ex.grouped(
        states, [*loop, "corrections"], lambda group, *_: {"samples": len(group)} | ex.spreads(group, *STATE)
    )
    mirrors = ex.grouped(kinds["alone"], ["pitch_m", "actuators", "error"], alone)
    return {
        "loops": ex.grouped(states, loop, loops),
        "states": by_step.astype({"corrections": int}),
        "causes": causes,
        "alone": mirrors.astype({"actuators": int}),
    }


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default's loops end, and leave no more than is asked."""
    loops = tables["loops"]
    return [
        *ex.checked(
            loops[loops.method == DEFAULT], "loops cut off, {diversity} diversity, bias {bias_nm:g} nm",
            "cut_off",
            "loops in which the estimate still fell at the last correction that is allowed: {cut_off}",
            high=0,
        ),
        *ex.checked(
            loops.dropna(subset="asked_nm"), "Noll 4–30 left, bias {bias_nm:g} nm", "worst_nm",
            "{worst_nm:.1f} nm RMS in the worst sample, asked {asked_nm:g} nm", high="asked_nm", unit="nm",
        ),
    ]  # fmt: skip


LISTINGS = [
    ex.Listing("loops", "Loops",
        {
            "calibration": "{method}", "diversity": "{diversity}", "bias [nm]": "{bias_nm:.0f}",
            "before [nm RMS]": "{before_nm:.0f}", "after one": "{after_one_nm:.0f}",
            "at the end": "{end_nm:.1f}", "worst sample": "{worst_nm:.1f}",
            "corrections": "{corrections:.0f}", "beyond Noll 30": "{beyond_nm:.0f}",
            "Strehl ratio before": "{strehl_before:.3f}", "Strehl at the end": "{strehl_end:.3f}",
            "Strehl without NCPAs": "{strehl_ideal:.3f}", "limited by": "{limit}",
        },
        caption="True wavefront in Noll 4–30, medians over {samples} sets of NCPAs; Strehl ratio at 1600 "
        "nm.",
        limit=("worst_nm", "asked_nm"), page="mirror_loop",
    ),
    ex.Listing("alone", "The mirror alone",
        {
            "actuators": "{actuators}", "errors of the mirror": "{error}",
            "before [nm RMS]": "{modes_nm_0:.0f}", "after one": "{modes_nm_1:.1f}",
            "two": "{modes_nm_2:.2f}", "three": "{modes_nm_3:.2f}", "six": "{modes_nm_6:.2f}",
            "beyond Noll 30, six": "{beyond_nm:.1f}",
        },
        caption="True wavefront in Noll 4–30 where every estimate is the truth, medians over all biases "
        "and sets of NCPAs.",
        page="mirror_alone",
    ),
    ex.Listing("causes", "Causes",
        {"calibration": "{method}", "diversity": "{diversity}", "bias [nm]": "{bias_nm:g}"},
        {"{cause}": "{modes_nm:.1f}, {beyond_nm:.1f}"},
        caption="Left at the end in Noll 4–30, and beyond [nm RMS]; medians. The causes add up as "
        "wavefronts.",
    ),
]  # fmt: skip


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """What is left after every correction."""
    states = drawn.tables["states"]
    states = states.assign(loop=states.method.map(METHOD_NAMES) + ", diversity " + states.diversity)
    return [ex.lines(
        "mirror-loop-left", "What is left in Noll 4–30",
        "Medians over the samples whose loop came that far, by the bias of the defocus [nm].",
        states, "corrections", "modes_nm", colour="loop", panels="bias_nm",
        labels=("corrections", "left in Noll 4–30 [nm RMS]"), size=(9.5, 4.2), width="full",
    )]  # fmt: skip


EXPERIMENT = ex.Experiment(
    "mirror_loop", 2, Sizes, "Correction by the deformable mirror",
    samples, rows, tables, checks, LISTINGS, figures,
    "{samples} sets of NCPAs at each bias of the defocus; a loop ends where the estimate falls no more.",
    "stars and mirrors",
)  # fmt: skip
