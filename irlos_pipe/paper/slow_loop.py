"""The slow focus loop closed on LIFT: what the wandering sodium layer leaves, against the star's magnitude.

One sample is one sky with its own NCPAs, calibrated on a narrow-band cube as an observer would, and a
few drifts. All loops of a sample (configurations, stars, gains) run on the same sky and drifts. The NCPAs
have no tip, tilt and defocus: a loop drives those to zero by itself, and its own zero is what counts here.
The 2x2 mode that the full pupil replaces runs on the same drifts, with the same star and sky.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
from matplotlib.figure import Figure as Canvas
from pydantic import Field

from irlos_pipe.control.linear_theory import Drift, Integrator, SodiumLayer, best_gain
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import focus_loop
from irlos_pipe.paper.common.calibrations import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.common.focus_loop import CENTROIDS, LIFT, TWO_BY_TWO, Loop, Records
from irlos_pipe.paper.common.observation import NoiseOf, Read, as_read, noise_of
from irlos_pipe.paper.common.ramps import TTF, Knowledge, calibrated
from irlos_pipe.paper.common.scenes import BRIGHT_MAG_J, FINE, in_four_images, star_scene
from irlos_pipe.report.drawing import BLUE, FAINT, ORANGE, svg
from irlos_pipe.simulate.scene import Scene

UNCALIBRATED = "uncalibrated"
# Children of a sample's seed; the last two are of the noise in the full-pupil and in the 2x2 mode.
SKY_STREAM, CUBE_STREAM, DRIFT_STREAM, *NOISE_STREAMS = range(5)
DRIFT_STEPS = 10  # steps of the drift per frame
SEEN = 0.85  # part of the aperture's photons in the window; hole, spider and halo lose the rest
SKY_FOCUS_NM = 5.0  # defocus of the AO residual in a frame of a second, as simulated
REACH_NM, NODES = 240.0, 8  # of the table of frames; a loop whose residual exceeds the reach has diverged
OVER_THEORY = 1.5
LABELS = {
    DEFAULT: "default calibration", PAPER_CHOICE: "NCPAs by DIP global", UNCALIBRATED: "uncalibrated",
    CENTROIDS: "2x2 mode, centroids", LIFT: "2x2 mode, fit of the four images",
}  # fmt: skip


class Sizes(ex.StageConfig):
    skies: int = Field(4, ge=1, le=1000, description="sets of NCPAs, each with its sky and its calibration")
    drifts: int = Field(1, ge=1, le=1000, description="drifts of the sodium layer on each sky")
    frames: int = Field(120, ge=10, le=100000, description="frames of 1 s per drift")
    settle: int = Field(20, ge=0, description="frames left out of the statistics")
    magnitudes: tuple[float, ...] = Field((12, 16, 17, 18, 19, 20), min_length=1, description="J mag")
    configurations: tuple[str, ...] = Field(
        (UNCALIBRATED, PAPER_CHOICE, DEFAULT, *TWO_BY_TWO),
        description="calibration methods, `uncalibrated`; of the 2x2 mode `centroids_2x2`, `lift_2x2`",
    )
    scan_magnitudes: tuple[float, ...] = Field((12, 18), description="stars of the scan of gains")
    scan_gains: tuple[float, ...] = Field((0.05, 0.1, 0.2, 0.6, 0.8), description="gains of the scan")
    half_rate: bool = Field(True, description="also frames of 2 s, with the default calibration")
    delay: int = Field(1, ge=0, le=10, description="frames between exposure and correction")
    seeing_arcsec: float = Field(0.5, gt=0, le=3, description="seeing on SPARTA's scale")
    calibration_frames: int = Field(100, ge=10, le=10000, description="frames of the calibration cube")
    noise: NoiseOf = "reads"
    layer: SodiumLayer = SodiumLayer()


# -- what is run -----------------------------------------------------------------------------------


def samples(ctx: ex.Context) -> ex.Samples:
    """One sky each, on which all loops run: every star at its best gain, and the scans; each loop once."""
    sizes, drift, read = ctx.config, drift_of(ctx), Read.of(ctx.instrument, ctx.config.noise, "slow_loop")
    sky = ex.sample(ctx, "noise", read=read)
    tried = [(name, 1) for name in sizes.configurations] + [(DEFAULT, 2)] * sizes.half_rate
    loops = [loop for name, exposures in tried for loop in at_best_gain(sky, drift, name, exposures)]
    loops += [Loop(DEFAULT, mag_j, gain) for mag_j in sizes.scan_magnitudes for gain in sizes.scan_gains]
    each = tuple(dict.fromkeys(loops))
    return ex.each(ctx, sizes.skies, "sky {index}", loops=each, drift=drift, read=read)


def drift_of(ctx: ex.Context) -> Drift:
    return ctx.config.layer.drift(ctx.instrument.facility.pupil.diameter_m)


def at_best_gain(sky: ex.Sample, drift: Drift, sensor: str, exposures: int) -> list[Loop]:
    """Return one loop per star, at the gain with the smallest predicted residual.

    The noise of a measurement is taken to be that of photons and detector, and the sky's defocus.
    """
    sizes = sky.sizes
    star = star_scene("noise", sky.facility, (0,), 1, 0.0, {}, seeing_arcsec=sizes.seeing_arcsec)
    if sensor in TWO_BY_TWO:
        star = in_four_images(star)
    measuring, noise = sensors_of([sensor], star)[sensor], noise_of(exposed_for(star, exposures, sky["read"]))
    loops = []
    for mag_j in sizes.magnitudes:
        photons_nm = measuring.photon_noise_nm(SEEN * star.photons * 10 ** (-0.4 * mag_j) * exposures, noise)
        noise_nm = float(np.hypot(photons_nm, SKY_FOCUS_NM / np.sqrt(exposures)))
        gain = best_gain(drift, noise_nm, float(exposures), sizes.delay)
        loops.append(Loop(sensor, mag_j, round(gain, 3), exposures))
    return loops


def rows(sky: ex.Sample) -> ex.Rows:
    """Calibrate the NCPAs of a sky and run its loops, first those of the full pupil, then of the 2x2 mode."""
    sizes, cube = sky.sizes, cube_of(sky)
    brightest, seed = min(loop.mag_j for loop in sky["loops"]), (*sky.seed, SKY_STREAM)
    of = sky.name, sky.facility, seed, sizes.frames, brightest, cube.ncpa_nm
    star = star_scene(*of, seeing_arcsec=sizes.seeing_arcsec)
    drift_nm = np.array([drawn_drift_nm(sky, index) for index in range(sizes.drifts)])
    for scene, stream in zip((star, in_four_images(star)), NOISE_STREAMS, strict=True):
        loops = [loop for loop in sky["loops"] if (loop.sensor in TWO_BY_TWO) == (scene is not star)]
        if loops:
            yield from _in_one_mode(sky, loops, scene, cube, drift_nm, stream)


def _in_one_mode(
    sky: ex.Sample, loops: Sequence[Loop], star: Scene, cube: Scene, drift_nm: np.ndarray, stream: int
) -> ex.Rows:
    scenes = {loop.exposures: exposed_for(star, loop.exposures, sky["read"]) for loop in loops}
    table = focus_loop.frame_table(star, REACH_NM, NODES)
    sensors = sensors_of([loop.sensor for loop in loops], star, cube, table)
    records = []
    for index, one in enumerate(drift_nm):
        rng = np.random.default_rng([*sky.seed, stream, index])
        records.append(focus_loop.close_loops(loops, sensors, scenes, table, one, sky.sizes.delay, rng))
    seen_e = float(table.images_e(0, np.zeros(1)).sum())
    for place, loop in enumerate(loops):
        scene, sensor = scenes[loop.exposures], sensors[loop.sensor]
        photons = seen_e * loop.brightness(scene.mag_j) * loop.exposures, noise_of(scene)
        yield {
            "loop": sky["loops"].index(loop),
            **asdict(loop),
            **{name: np.array([getattr(one, name)[place] for one in records]) for name in Records._fields},
            "drift_nm": drift_nm,
            "sky_focus_nm": table.sky_focus_nm,
            "bound_nm": sensor.bound_nm(*photons),
            "photon_noise_nm": sensor.photon_noise_nm(*photons),
        }


def cube_of(sky: ex.Sample) -> Scene:
    """Return the recording that the NCPAs are calibrated on."""
    own = replace(sky, name=f"{sky.name}, calibration", seed=(*sky.seed, CUBE_STREAM))
    of_cube = sky.sizes.seeing_arcsec, sky.sizes.calibration_frames, BRIGHT_MAG_J
    return own.cube(*of_cube, without=TTF, sampling=FINE)


def exposed_for(star: Scene, frames: int, read: Read | None) -> Scene:
    """Return the same star in exposures of so many frames, with the noise of their reads."""
    exposure_s = frames * star.exposure_s
    return as_read(replace(star, exposure_s=exposure_s, frame_rate_hz=1 / exposure_s), read)


def drawn_drift_nm(sky: ex.Sample, index: int) -> np.ndarray:
    """Return the mean defocus of the disturbance in every frame, (frames,)."""
    rng, frames = np.random.default_rng([*sky.seed, DRIFT_STREAM, index]), sky.sizes.frames
    steps = sky["drift"].draw_nm(rng, frames * DRIFT_STEPS, 1 / DRIFT_STEPS)
    return steps.reshape(frames, DRIFT_STEPS).mean(1)


def sensors_of(
    names: Sequence[str], star: Scene, cube: Scene | None = None, table: focus_loop.FrameTable | None = None
) -> Mapping[str, focus_loop.FocusSensor]:
    """Return what measures the defocus of a `star`, by name, its NCPAs calibrated on a `cube` if given."""
    if star.lenslets > 1:
        return focus_loop.two_by_two_sensors(star, table)
    known = calibrated(cube, [name for name in names if name != UNCALIBRATED]) if cube else {}
    of_sensor = {name: known.get(name, Knowledge()) for name in names}
    return {name: focus_loop.focus_sensor(star, knowledge) for name, knowledge in of_sensor.items()}


# -- what came out ---------------------------------------------------------------------------------


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """Every loop, what theory expects and what happened; and what they had to correct."""
    sizes, drift = ctx.config, drift_of(ctx)
    focus_nm, drift_nm = ex.stacked(rows.drop_duplicates("sample"), "sky_focus_nm", "drift_nm")
    sky_focus_nm = float(np.sqrt(np.mean(np.var(focus_nm, axis=1, ddof=1))))

    def summary(group, _, sensor, mag_j, gain, exposures):
        records = Records(*ex.stacked(group, *Records._fields))
        outcome = focus_loop.outcome_of(records, drift, sizes.settle)
        noise_nm = float(np.hypot(np.median(group.photon_noise_nm), sky_focus_nm / np.sqrt(exposures)))
        integrator = Integrator(gain, float(exposures), sizes.delay)
        return {"label": LABELS.get(sensor, sensor), **outcome} | {
            "bound_nm": np.median(group.bound_nm),
            "expected_noise_nm": noise_nm,
            "predicted_nm": integrator.residual_nm(drift, noise_nm),
            "best_gain": best_gain(drift, noise_nm, float(exposures), sizes.delay),
            "gain_margin": integrator.gain_margin(outcome["slope"]),
        }

    sky = {
        "sky_focus_nm": sky_focus_nm,
        "open_loop_nm": float(np.sqrt(np.mean(drift_nm[:, :, sizes.settle :] ** 2))),
        "largest_stable_gain": Integrator(1.0, 1.0, sizes.delay).largest_stable_gain,
        "delay": sizes.delay,
        **{f"drift_{name}": value for name, value in asdict(drift).items()},
    }
    by = ["loop", "sensor", "mag_j", "gain", "exposures"]
    loops = ex.grouped(rows.sort_values("loop", kind="stable"), by, summary)
    return {"sky": ex.frame([sky]), "loops": loops}


def best_loops(loops: ex.Frame, sensor: str) -> ex.Frame:
    """Return the loops of one `sensor` with frames of 1 s at their best gain, which is listed first."""
    own = loops[(loops.sensor == sensor) & (loops.exposures == 1)]
    return own.drop_duplicates("mag_j").sort_values("mag_j")


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default meets linear theory on the brightest star, and leaves no more than 2x2 centroids on any.

    The paper expects the latter of the full pupil.
    """
    default, centroids = (best_loops(tables["loops"], name) for name in (DEFAULT, CENTROIDS))
    checks = ex.checked(
        default.iloc[:1], "residual over prediction", lambda row: row["residual_nm"] / row["predicted_nm"],
        "bright star: {value:.2f} of the prediction", high=OVER_THEORY,
    )  # fmt: skip
    held = centroids[centroids.diverged < centroids.runs].set_index("mag_j").residual_nm
    pairs = [
        (row.residual_nm / held[row.mag_j], row.mag_j) for row in default.itertuples() if row.mag_j in held
    ]
    if pairs:
        worst, mag_j = max((math.inf if math.isnan(ratio) else ratio, mag_j) for ratio, mag_j in pairs)
        text = f"{worst:.2f} at m_J {mag_j:g}, where it is largest"
        checks.append(ex.check("residual over that of the 2x2 centroids", worst, text, high=1.0))
    return checks


LISTING = ex.Listing("loops", "Loops",
    {
        "sensor": "{label}", "m_J": "{mag_j:g}", "exposure [s]": "{exposures}", "gain": "{gain:.2f}",
        "best by theory": "{best_gain:.2f}", "sensor noise [nm]": "{noise_nm:.1f}",
        "bound [nm]": "{bound_nm:.1f}", "predicted [nm]": "{predicted_nm:.1f}",
        "residual [nm]": "{residual_nm:.1f}",
        "its error": "{residual_error_nm:.1f}", "bias [nm]": "{bias_nm:.1f}",
        "lost": "{lost:.0%}", "diverged": "{diverged} of {runs}", "sensor slope": "{slope:.2f}",
        "gain margin": "{gain_margin:.1f}",
    },
    caption="Sensor noise: measured minus true residual, the AO residual's own defocus included. Bias: "
    "RMS over skies of the mean residual. Lost: measurements that the sensor could not give. Gain margin: "
    "factor to oscillation. The 2x2 mode is told its own zero without error.",
)  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """The residuals of every loop, the drifts, and the sky's own defocus."""
    drift_nm, focus_nm = ex.stacked(rows.drop_duplicates("sample"), "drift_nm", "sky_focus_nm")
    by_sky = rows.sort_values("loop", kind="stable").groupby("sample", sort=False)
    residual_nm = np.stack([np.stack(list(own.residual_nm), axis=1) for _, own in by_sky])
    return {
        "residual_nm": ex.Quantity(residual_nm, "nm", "residual defocus (sky, drift, loop, frame of 1 s)"),
        "drift_nm": ex.Quantity(drift_nm, "nm", "defocus of the sodium layer (sky, drift, frame)"),
        "sky_focus_nm": ex.Quantity(focus_nm, "nm", "defocus of the AO residual (sky, frame)"),
    }


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """A bright and a faint star, and residual, noise and gain of all loops."""
    sky, loops = drawn.tables["sky"].iloc[0], drawn.tables["loops"]
    best = loops.drop_duplicates(["sensor", "exposures", "mag_j"]).sort_values("mag_j", kind="stable")
    best = best.assign(line=best.label + best.exposures.map({1: "", 2: ", 2 s"}))
    dashed = "Dashed: by theory, with the noise of photons and detector and the AO residual's own defocus."
    found: ex.Blocks = [
        ex.lines(
            "loop-magnitude", "Residual against magnitude",
            f"{dashed} Dotted: without a loop. Nothing is fitted.",
            best, "mag_j", "residual_nm", colour="line", dashed="predicted_nm",
            labels=("J magnitude", "residual defocus [nm RMS]"), levels=[sky.open_loop_nm],
        ),
        ex.lines(
            "loop-noise", "The loop's sensor", f"{dashed} Dotted: that alone.",
            best, "mag_j", "noise_nm", colour="line", dashed="expected_noise_nm",
            labels=("J magnitude", "noise of a measurement [nm RMS]"), levels=[sky.sky_focus_nm],
        ),
    ]  # fmt: skip
    default = best_loops(loops, DEFAULT)
    if len(default):
        chosen = [*default.iloc[:1].itertuples(), *default[default.diverged == 0].iloc[-1:].itertuples()]

        def draw(figure: Canvas) -> None:
            panels = figure.subplots(len(chosen), sharex=True, sharey=True, squeeze=False)[:, 0]
            for axes, row, ink in zip(panels, chosen, (BLUE, ORANGE), strict=False):
                axes.plot(drawn.array("drift_nm")[0, 0], color=FAINT, linewidth=2.2, label="open loop")
                residual_nm = drawn.array("residual_nm")[0, 0, row.loop]
                axes.plot(residual_nm, color=ink, linewidth=1.1, label=f"closed, m_J {row.mag_j:g}")
                axes.legend(loc="upper left", ncols=2)
                axes.set_ylabel("defocus [nm RMS]")
            panels[-1].set_xlabel("time [s]")

        series = svg("loop-series", (5.2, 4.2), draw)
        found.insert(0, ex.Figure(series, "Bright and faint star", "First sky. Grey: the drift."))
    own = loops[(loops.sensor == DEFAULT) & (loops.exposures == 1)].sort_values("gain", kind="stable")
    scanned = own[own.groupby("mag_j").gain.transform("size") > 1]
    if len(scanned):
        found.append(ex.lines(
            "loop-gain", "Residual against gain", "By m_J; dotted: gain at which the loop oscillates.",
            scanned, "gain", "residual_nm", colour="mag_j", dashed="predicted_nm", yscale="linear",
            labels=("gain", "residual defocus [nm RMS]"), marks=[sky.largest_stable_gain],
        ))  # fmt: skip
    return found


EXPERIMENT = ex.Experiment(
    "slow_loop", 9, Sizes, "Slow focus loop on LIFT",
    samples, rows, tables, checks, [LISTING], figures,
    "Sodium layer drifting by {drift_rms_change_1s_nm:.1f} nm RMS of defocus in a second; {open_loop_nm:.0f} "
    "nm RMS without a loop. The NCPAs have no tip, tilt and defocus of their own.", "skies", arrays,
)  # fmt: skip
