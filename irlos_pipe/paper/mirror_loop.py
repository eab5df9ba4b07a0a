"""NCPAs corrected by a deformable mirror until nothing improves (paper, Sect. 6.1).

A cube of the star is calibrated, the mirror is sent minus the estimate, and the next cube is taken through
what the mirror made of it. The mirror is not the one that its control believes in: its gain is off, and its
actuators are shifted and turned against the pupil. The star was refocused before, or has a defocus bias.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, DEFOCUS, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.correction import predict_correction
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import calibrations, scenes
from irlos_pipe.paper.common.calibrations import DEFAULT, PAPER_CHOICE, VARIANTS, ObservedCube
from irlos_pipe.paper.common.ramps import knowledge_of
from irlos_pipe.paper.common.scenes import FINE, star_image
from irlos_pipe.simulate.exposure import telescope_of
from irlos_pipe.simulate.mirror import Actuators, Mirror
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope

CUBE_STREAM = 10  # child of a sample's seed; every further cube has another sky
FITTED_BY = 6  # corrections after which an aligned mirror leaves what it cannot make
# Highest Noll mode of the fit, so that modes beyond the corrected ones do not leak into them.
LAST_FITTED = 66
# How the diversity is made: as declared, or by the same mirror with the same errors.
EXACT, BY_MIRROR = "exact", "mirror"
LEFT = ("modes_nm", "beyond_nm", "all_nm")  # residual in Noll 4–30, beyond these modes, and in all

IMPROVES = 0.9  # an estimate is applied where it is below this part of the one before
ASKED_NM = 10.0  # requirement on the default with the declared diversity, in Noll 4–30
LOOPS = ((DEFAULT, EXACT), (PAPER_CHOICE, EXACT), (DEFAULT, BY_MIRROR))
STATE = (*LEFT, "strehl", "seen_nm")


class Bench:
    """A star, its wavefront on the pupil of the simulator, and what mirrors leave of it."""

    def __init__(self, scene: Scene, star_frames: int):
        self.scene, self.star_frames = scene, star_frames
        self.telescope: Telescope = telescope_of(scene)
        self.opd_nm = self.telescope.opd_nm(scene.ncpa_nm)

    def cube(self, mirror: Mirror, index: int, diversity: str) -> Scene:
        """Return the cube number `index`, taken through the mirror."""
        scene = replace(self.scene, mirror=mirror, seed=(*self.scene.seed, CUBE_STREAM + index))
        if diversity == EXACT:
            return scene
        # The scene adds the diversity as declared; here the mirror makes it, so that it is taken out once.
        declared_nm = scene.diversity_nm
        ncpa_nm = {noll: value - declared_nm.get(noll, 0.0) for noll, value in scene.ncpa_nm.items()}
        made = corrected(mirror, {noll: -value for noll, value in declared_nm.items()})
        return replace(scene, ncpa_nm=ncpa_nm, mirror=made)

    def coefficients_nm(self, opd_nm: np.ndarray) -> dict[int, float]:
        """Return Noll 2..30 of a wavefront `opd_nm`, (n, n), fitted jointly with modes beyond [nm RMS]."""
        fitted_nm = self.telescope.fit_zernike_nm(opd_nm, LAST_FITTED)[: len(REPORTED_NOLLS)]
        return dict(enumerate(fitted_nm.tolist(), start=2))

    def of(self, opd_nm: np.ndarray) -> dict[str, float]:
        """Return the RMS of parts of a wavefront, see `LEFT`, without tip and tilt."""
        found_nm = self.coefficients_nm(opd_nm)
        modes_nm = self.telescope.opd_nm({noll: found_nm[noll] for noll in CORRECTED_NOLLS})
        still_nm = opd_nm - self.telescope.opd_nm({noll: found_nm[noll] for noll in TIP_TILT})
        parts = modes_nm, still_nm - modes_nm, still_nm
        return {
            name: calibrations.weighted_rms(part, self.telescope.transmission)
            for name, part in zip(LEFT, parts, strict=True)
        }

    def through(self, mirror: Mirror) -> np.ndarray:
        """Return the wavefront that a mirror leaves, (n, n) [nm]."""
        return self.opd_nm + mirror.opd_nm(self.telescope)

    def strehl(self, mirror: Mirror) -> float:
        """Return the Strehl ratio of the star, which the fast loop keeps centred."""
        moved_nm = self.coefficients_nm(mirror.opd_nm(self.telescope))
        ncpa_nm = {**self.scene.ncpa_nm} | {noll: -moved_nm[noll] for noll in TIP_TILT}
        return star_image(replace(self.scene, mirror=mirror), self.star_frames, ncpa_nm)[1]

    def unseen_nm(self, mirror: Mirror, diversity: str) -> np.ndarray | float:
        """Return by how much the diversity differs from the one declared, (n, n) [nm]: in cubes only."""
        declared_nm = self.scene.diversity_nm
        if diversity == EXACT:
            return 0.0
        made_nm = replace(mirror, offsets_nm=declared_nm).opd_nm(self.telescope)
        return made_nm - self.telescope.opd_nm(declared_nm)

    def told(self, mirror: Mirror, corrections: int, unseen_nm: np.ndarray | float = 0.0) -> list[np.ndarray]:
        """Return the wavefronts that a mirror leaves when every estimate is the truth, before and after each.

        The truth of the cubes, which is with `unseen_nm`.
        """
        states = [self.through(mirror)]
        for _ in range(corrections):
            mirror = corrected(mirror, self.coefficients_nm(states[-1] + unseen_nm))
            states.append(self.through(mirror))
        return states

    def causes(self, mirror: Mirror, done: int, diversity: str) -> dict[str, dict[str, float]]:
        """Split what is left after `done` corrections by its causes, whose wavefronts add up to it."""
        real = replace(mirror, offsets_nm={})
        finer_nm = {noll: value for noll, value in self.scene.ncpa_nm.items() if noll > CORRECTED_NOLLS[-1]}
        states = {
            "finer": self.telescope.opd_nm(finer_nm),
            "fitting": self.told(Mirror(mirror.actuators), FITTED_BY)[-1],
            "registration": self.told(real, done)[-1],
            "diversity": self.told(real, done, self.unseen_nm(real, diversity))[-1],
            "estimate": self.through(mirror),
        }
        parts = np.diff([np.zeros_like(self.opd_nm), *states.values()], axis=0)
        return {cause: self.of(part) for cause, part in zip(states, parts, strict=True)}


def corrected(mirror: Mirror, seen_nm: Mapping[int, float]) -> Mirror:
    """Return a mirror after one more estimate, Noll: nm RMS; its offsets of tip and tilt stay."""
    offsets_nm = {noll: mirror.offsets_nm.get(noll, 0.0) - seen_nm.get(noll, 0.0) for noll in CORRECTED_NOLLS}
    return replace(mirror, offsets_nm=offsets_nm)


class Sizes(ex.StageConfig):
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
    sizes, bench = star.sizes, Bench(scene_of(star), star.sizes.star_frames)
    ideal = star_image(bench.scene, sizes.star_frames, {})[1]
    for method, diversity in LOOPS:
        loop = {"method": method, "diversity": diversity}
        mirror, seen_nm = mirror_of(star, sizes.pitches_m[0]), math.inf
        for done in range(sizes.corrections + 1):
            cube = ObservedCube.of(bench.cube(mirror, done, diversity))
            calibration = cube.calibrated(VARIANTS[method])
            estimate_nm = dict(zip(calibration.nolls, calibration.zernike_nm.tolist(), strict=True))
            before_nm, seen_nm = (
                seen_nm,
                float(np.linalg.norm([estimate_nm[noll] for noll in CORRECTED_NOLLS])),
            )
            falling = not done or seen_nm < IMPROVES * before_nm
            last = not falling or done == sizes.corrections
            state = bench.of(bench.through(mirror)) | {"strehl": bench.strehl(mirror), "seen_nm": seen_nm}
            yield {"what": "state", **loop, "corrections": done, **state, "last": last, "falling": falling}
            if not done:
                predicted = predicted_strehl(cube, calibration)
                yield {"what": "star", **loop, "predicted": predicted, "ideal": ideal}
            if last:
                break
            mirror = corrected(mirror, estimate_nm)
        for cause, left in bench.causes(mirror, done, diversity).items():
            yield {"what": "cause", **loop, "cause": cause, **left}
    for pitch_m in sizes.pitches_m:
        for error, mirror in alone(mirror_of(star, pitch_m)).items():
            which = {"pitch_m": pitch_m, "actuators": int(mirror.actuators.present.sum()), "error": error}
            for done, left_nm in enumerate(bench.told(mirror, sizes.corrections)):
                yield {"what": "alone", **which, "corrections": done, **bench.of(left_nm)}


def scene_of(star: ex.Sample) -> Scene:
    of_cube = star.sizes.seeing_arcsec, star.sizes.frames, star.sizes.mag_j
    cube = star.cube(*of_cube, sampling=FINE, **scenes.BY_MIRROR)
    return replace(cube, ncpa_nm={**cube.ncpa_nm, DEFOCUS: star["bias_nm"]})


def mirror_of(star: ex.Sample, pitch_m: float) -> Mirror:
    """Return the mirror with all its errors and with actuators `pitch_m` apart, at rest."""
    sizes, diameter_m = star.sizes, star.facility.pupil.diameter_m
    return Mirror(Actuators(diameter_m, pitch_m), sizes.gain, (sizes.shift * diameter_m, 0.0), sizes.turn_deg)


def alone(mirror: Mirror) -> dict[str, Mirror]:
    """Return mirrors with none of the errors of a `mirror`, with each, the gain too high, and with all."""
    aligned = Mirror(mirror.actuators)
    return {
        "none": aligned,
        "gain": replace(aligned, gain=mirror.gain),
        "opposite gain": replace(aligned, gain=2 - mirror.gain),
        "shift": replace(aligned, shift_m=mirror.shift_m),
        "turn": replace(aligned, turn_deg=mirror.turn_deg),
        "all": mirror,
    }


def predicted_strehl(cube: ObservedCube, calibration: Calibration) -> float:
    """Return the Strehl ratio that the stage `correct` predicts of the star after a full correction."""
    effects = list(knowledge_of(cube, calibration).effects.values())
    gain = np.isin(calibration.nolls, REPORTED_NOLLS).astype(float)
    modes = calibration.nolls, calibration.fitted_modes_nm, calibration.zernike_nm
    return predict_correction(cube.settings, *modes, gain, effects).strehl_after


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
            **ex.spreads(numbers, *numbers),
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
        limit=("worst_nm", "asked_nm"),
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
    states = states.assign(
        loop=states.method.map(calibrations.METHOD_NAMES) + ", diversity " + states.diversity
    )
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
