"""The paper's first test on sky, simulated: two stars, a focus stage with errors, unknown NCPAs.

Target 1 is recorded in ping-pong order, so that hysteresis of the focus stage makes a saw-tooth; half of
target 2 was recorded in a second run with another reference of the stage. The truth being known here, the
lessons of the test get numbers: the gain by elongation prior, kernel, more modes and NCPAs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas
from pydantic import Field
from scipy import stats

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp import summarise, travel_direction
from irlos_pipe.paper import experiment as ex
from irlos_pipe.paper.common import ramps
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import BRIGHT_MAG_J
from irlos_pipe.paper.common.ramps import KERNEL_MAS, NINE, TTF, LiftVariant, ObservedRamp
from irlos_pipe.paper.common.reads import on_spartas_scale
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.effects.wavefront import reached_nm
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene

WRONG_NM = 50.0  # an estimate this far from the best minimum lies in another one
BY_CHANCE = 1e-3  # probability with which right errors give a larger pull
STARTED = ("hand_9", "default_3")  # the paper's variant and this project's, begun from every start
DRAWN = {"hand_9": "the paper: kernel by hand, nine modes", "default_3": "this pipeline, three modes"}


@dataclass(frozen=True)
class Target:
    """One star and how its ramp was recorded.

    `seeing_arcsec` is by MASS-DIMM, `kernel_mas` the σ_obj that the paper tuned by hand. The stage stops
    `hysteresis_nm` beyond the commanded position, in the direction of travel, or the positive half has
    another reference, `second_run_bias_nm`.
    """

    label: str
    mag_j: float
    seeing_arcsec: float
    reach_nm: tuple[float, float]
    kernel_mas: float
    hysteresis_nm: float = 0.0
    second_run_bias_nm: float = 0.0

    @property
    def stage_effects(self) -> dict[str, dict[str, float]]:
        """Return the errors of the focus stage as effects of a scene."""
        effects = {
            "focus_stage_hysteresis": {"nm": self.hysteresis_nm},
            "focus_stage_offset": {"nm": self.second_run_bias_nm, "above_nm": 0.0},
        }
        return {name: effect for name, effect in effects.items() if effect["nm"]}

    def order(self, offsets: int) -> np.ndarray:
        """Return the offsets in the order of recording: ping-pong, or from end to end."""
        ascending = np.linspace(*self.reach_nm, offsets)
        return ramps.ping_pong(ascending.tolist()) if self.hysteresis_nm else ascending


TARGETS = {
    "target_1": Target("target 1", 9.0, 0.5, (-432.0, 467.0), KERNEL_MAS, hysteresis_nm=15.0),
    "target_2": Target("target 2", 12.5, 1.5, (-302.0, 288.0), 14.5, second_run_bias_nm=40.0),
}


def variants_of(target: Target) -> dict[str, LiftVariant]:
    """Return the variants of LIFT for a target: the kernel without NCPAs, then with the NCPAs."""
    text = f"kernel {target.kernel_mas:g} mas by hand"
    by_hand = LiftVariant(text, NINE, halo="off", kernel=target.kernel_mas)
    residual = LiftVariant("AO residual and jitter as expected", NINE)
    default = LiftVariant("NCPAs, AO residual and jitter as calibrated", NINE, ncpa=DEFAULT)
    return {
        "point_9": LiftVariant("no kernel", NINE, halo="off", kernel=0.0),
        "hand_3": replace(by_hand, modes=TTF),
        "hand_9": by_hand,
        "fit_9": LiftVariant("kernel fitted to the ramp", NINE, halo="off", kernel="fit"),
        "residual_3": replace(residual, modes=TTF),
        "residual_9": residual,
        "ncpa_hand_3": replace(by_hand, name=f"NCPAs, {text}", modes=TTF, ncpa=DEFAULT),
        "default_3": replace(default, modes=TTF),
        "default_9": default,
    }


class Sizes(ex.StageConfig):
    """Sizes of the experiment."""

    samples: int = Field(3, ge=1, le=1000, description="sets of NCPAs per target; the first is drawn")
    offsets: tuple[int, int] = Field((10, 8), description="positions of the ramps of the two targets")
    frames_per_offset: tuple[int, int] = Field((10, 20), description="of the first ramp of each target")
    frames_of_others: int = Field(2, ge=1, le=1000, description="frames per offset of the other ramps")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    ncpa_nm: float = Field(170.0, ge=0, le=1000, description="NCPAs over 50 modes: strong ones [nm RMS]")


def samples(ctx: ex.Context) -> Iterator[ex.Sample]:
    """One set of NCPAs for a target; its first ramp has the paper's number of frames, the others few."""
    sizes = ctx.config
    for place, (key, target) in enumerate(TARGETS.items()):
        seeing = on_spartas_scale(ctx.instrument, target.seeing_arcsec)
        for index in range(sizes.samples):
            frames = sizes.frames_of_others if index else sizes.frames_per_offset[place]
            of = {"target": key, "ramp": index, "sparta_arcsec": seeing}
            order_nm = np.repeat(target.order(sizes.offsets[place]), frames).tolist()
            yield ex.sample(ctx, f"{target.label}, ramp {index}", place, index, **of, order_nm=order_nm)


def rows(star: ex.Sample) -> ex.Rows:
    """Simulate a ramp and estimate it by every variant, and by two of them from every start."""
    target = TARGETS[star["target"]]
    cube, ramp = scenes_of(star)
    exposed, commanded_nm = expose(ramp), ramp.introduced_per_frame_nm
    observed = ramps.observe(ramp, exposed, ramps.calibrated(cube, [DEFAULT]))
    introduced_nm = reached_nm(commanded_nm, effects_of(ramp.effects), ramp.rng("focus_stage"))
    true_nm = ramps.true_modes_nm(ramp, exposed)[:, DEFOCUS - 2]
    for key, variant in variants_of(target).items():
        fit = observed.estimate(variant)
        given_nm, line = observed.given_defocus_nm(variant), summarise(introduced_nm, fit.defocus_nm)
        wrong_nm = fit.defocus_nm + given_nm - true_nm
        yield {
            "variant": key,
            "frames": len(commanded_nm),
            "slope": line.slope,
            "rms_nm": float(np.sqrt(np.nanmean(wrong_nm**2))),
            "line_rms_nm": line.residual_rms_nm,
            "converged": float(np.mean(fit.result.solution.converged.numpy())),
            "kernel_mas": fit.effects.get("tip_tilt_jitter", {}).get("sigma_mas", np.nan),
            **stage_error(target, commanded_nm, fit.defocus_nm),
            "commanded_nm": commanded_nm,
            "reached_nm": introduced_nm,
            "without_ncpa_nm": fit.defocus_nm + given_nm - ramp.ncpa_nm[DEFOCUS],
        }
        for start, result in _started(observed, variant).items() if key in STARTED else ():
            yield {"variant": key, "start": start, **result}


def scenes_of(star: ex.Sample) -> tuple[Scene, Scene]:
    """Return calibration cube and ramp of a sample, both under the seeing of the target."""
    target, sizes = TARGETS[star["target"]], star.sizes
    ncpa_nm = draw_ncpa_nm(np.random.default_rng(star.seed), star.facility.ncpa_law, sizes.ncpa_nm)
    cube = star.cube(star["sparta_arcsec"], sizes.cube_frames, BRIGHT_MAG_J)
    cube = replace(cube, ncpa_nm=ncpa_nm, sampling=FINE)
    ramp = ramps.ramp_scene(cube, target.mag_j, star["order_nm"])
    return cube, replace(ramp, effects=target.stage_effects)


def stage_error(target: Target, commanded_nm: np.ndarray, estimated_nm: np.ndarray) -> dict[str, float]:
    """Return the error of the focus stage as found by a user who knows the commanded defocus only.

    The saw-tooth of target 1, twice the hysteresis, or the bias of the second run of target 2.
    """
    second_run = None if target.hysteresis_nm else commanded_nm > 0
    line = summarise(commanded_nm, estimated_nm, second_run)
    if target.hysteresis_nm:
        true_nm, found = 2 * target.hysteresis_nm, (line.saw_tooth_nm, line.saw_tooth_sigma_nm)
    else:
        true_nm, found = target.second_run_bias_nm, (line.part_bias_nm, line.part_bias_sigma_nm)
    return {"stage_true_nm": true_nm, "stage_found_nm": found[0], "stage_sigma_nm": found[1]}


def _started(observed: ObservedRamp, variant: LiftVariant) -> dict[str, dict[str, np.ndarray]]:
    """Whether LIFT ends in the best minimum found, and after how many iterations, from every start."""
    model = ImageModel(observed.model(variant), observed.effects(variant))
    elongation_nm = observed.start_nm(variant, model.psf)
    found = ramps.from_every_start(model, observed.data, elongation_nm, LiftOptions("data"))
    results = {name: result for name, (_, result) in found.items()}
    wrong = wrong_minima(results)
    return {
        name: {"wrong": wrong[name], "iterations": result.solution.iterations.numpy()}
        for name, result in results.items()
    }


def wrong_minima(results: Mapping[str, LiftResult]) -> dict[str, np.ndarray]:
    """Return which frames did not converge or lie far from the best of all starts, (frames,) per start."""
    defocus = torch.stack([result.mode(DEFOCUS)[0] for result in results.values()])
    converged = torch.stack([result.solution.converged for result in results.values()])
    chi2 = torch.stack([result.chi2_nu for result in results.values()])
    best = torch.where(converged, chi2, torch.inf).argmin(0)
    apart = (defocus - defocus.gather(0, best[None])).abs() > WRONG_NM
    return dict(zip(results, (~converged | apart).numpy(), strict=True))


def tables(rows: ex.Frame, ctx: ex.Context) -> ex.Tables:
    """The targets; every ramp by every variant; and the frames of all ramps by start."""

    def target(key: str, own: Target) -> dict[str, Any]:
        error = "saw_tooth" if own.hysteresis_nm else "second_run_bias"
        facts = {"label": own.label, "mag_j": own.mag_j, "seeing_arcsec": own.seeing_arcsec}
        seeing = on_spartas_scale(ctx.instrument, own.seeing_arcsec)
        return {
            "target": key,
            **facts,
            "sparta_arcsec": seeing,
            "samples": ctx.config.samples,
            "stage_error": error,
        }

    def start(group: ex.Frame) -> dict[str, Any]:
        wrong, iterations = (np.concatenate(list(group[name])) for name in ("wrong", "iterations"))
        return {
            "frames": len(wrong),
            "wrong": int(wrong.sum()),
            "median_iterations": float(np.median(iterations)),
        }

    every = rows[rows.start.isna()]
    variants = {(key, name): one for key, own in TARGETS.items() for name, one in variants_of(own).items()}
    own = [variants[pair] for pair in zip(every.target, every.variant, strict=True)]
    names = [
        "target",
        "ramp",
        "variant",
        "frames",
        "slope",
        "rms_nm",
        "line_rms_nm",
        "converged",
        "kernel_mas",
    ]
    names += ["stage_true_nm", "stage_found_nm", "stage_sigma_nm"]
    shown = every[names].assign(label=[one.name for one in own], modes=[len(one.modes) for one in own])
    return {
        "targets": ex.frame(target(*one) for one in TARGETS.items()),
        "ramps": shown.astype({"frames": int}),
        "starts": ex.grouped(rows[rows.start.notna()], ["target", "variant", "start"], start),
    }


def checks(tables: ex.Tables) -> list[ex.Check]:
    """The default finds the focus stage's error, from its own start."""
    found, ramps_, starts = [], tables["ramps"], tables["starts"]
    for row in tables["targets"].itertuples():
        own = ramps_[(ramps_.target == row.target) & (ramps_.variant == "default_3")]
        pull, count, true_nm = pull_of(own), len(own), own.stage_true_nm.iloc[0]
        limit = float(np.sqrt(stats.chi2.isf(BY_CHANCE, count) / count))
        text = f"{pull:.1f}, RMS over {count} ramps, of an introduced error of {true_nm:g} nm"
        found.append(ex.at_most(f"pull of the focus stage's error, {row.label}", pull, limit, text))
        first = starts[
            (starts.target == row.target) & (starts.variant == "default_3") & (starts.start == "default")
        ]
        wrong, frames = first.wrong.iloc[0], first.frames.iloc[0]
        text = f"{wrong} of {frames} frames of the default"
        found.append(ex.at_most(f"frames in a wrong minimum, {row.label}", wrong, 0, text))
    return found


def pull_of(group: ex.Frame) -> float:
    """Return the RMS over the ramps of (found − true) / error, of the focus stage's error."""
    pulls = (group.stage_found_nm - group.stage_true_nm) / group.stage_sigma_nm
    return float(np.sqrt(np.mean(pulls.to_numpy() ** 2)))


LISTINGS = [
    ex.Listing("ramps", "Every ramp, by what is in the model",
        {"target": "{target}", "estimate": "{label}", "modes": "{modes}"},
        {
            "error of ramp {ramp} [nm RMS]": "{rms_nm:.1f}",
            "stage, ramp {ramp}": "{stage_found_nm:+.0f} ± {stage_sigma_nm:.0f}",
        },
        caption="Error against the true defocus of every frame (reached by the stage, NCPAs, AO "
        "residual). Stage: its error as a user finds it who knows only the commanded defocus [nm]; true "
        "are 30 (saw-tooth of target 1) and 40 (second run of target 2).",
    ),
    ex.Listing("starts", "Influence of the start",
        {"estimate": "{variant}", "start": "{start}"},
        {"{target}: wrong": "{wrong} of {frames}", "{target}: iterations": "{median_iterations:.0f}"},
        caption="Wrong: did not converge, or ended more than 50 nm from the best of the minima that the "
        "starts found. Iterations: median, variances from the images.",
    ),
]  # fmt: skip


def arrays(rows: ex.Frame, ctx: ex.Context) -> dict[str, ex.Quantity]:
    """The first ramp of every target, frame by frame in the order of recording."""
    found, names = {}, ("commanded_nm", "reached_nm", "without_ncpa_nm")
    for row in rows[(rows.ramp == 0) & rows.variant.isin(DRAWN) & rows.start.isna()].itertuples():
        for name in names:
            found[f"{row.target}/{row.variant}/{name}"] = ex.Quantity(
                getattr(row, name), "nm", "defocus, first ramp"
            )
    return found


def figures(drawn: ex.Drawn) -> ex.Blocks:
    """The first ramp of every target: what was estimated beyond what was commanded."""
    caption = "First ramp, the defocus of the NCPAs taken off; line: error of the focus stage."
    found = []
    for row in drawn.tables["targets"].itertuples():
        seeing = f'seeing {row.seeing_arcsec:g}" by MASS-DIMM ({row.sparta_arcsec:.2g}" by SPARTA)'
        title = f"{row.label.capitalize()}: m_J {row.mag_j:g}, {seeing}"
        found.append(ex.Figure(_ramp(drawn, row.target, row.stage_error), title, caption, "full"))
    return found


def _ramp(drawn: ex.Drawn, target: str, stage_error: str) -> Markup:
    saw_tooth = stage_error == "saw_tooth"
    names = ("reached upwards", "reached downwards") if saw_tooth else ("second run", "first run")

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(DRAWN), sharex=True, sharey=True)
        for axes, (variant, title) in zip(panels, DRAWN.items(), strict=True):
            commanded_nm, reached, found_nm = (
                drawn.array(f"{target}/{variant}/{name}")
                for name in ("commanded_nm", "reached_nm", "without_ncpa_nm")
            )
            direction = travel_direction(commanded_nm) if saw_tooth else np.sign(commanded_nm)
            upwards = np.where(direction == 0, commanded_nm, direction) > 0
            for name, own, look, ink in zip(names, (upwards, ~upwards), "^v", (ORANGE, BLUE), strict=True):
                axes.plot(
                    commanded_nm[own],
                    (found_nm - commanded_nm)[own],
                    look,
                    color=ink,
                    markersize=3.5,
                    label=name,
                )
            order = np.argsort(commanded_nm, kind="stable")
            error_nm = (reached - commanded_nm)[order]
            axes.step(
                commanded_nm[order], error_nm, where="mid", color=INK, linewidth=1.0, label="focus stage"
            )
            axes.set(title=title, xlabel="commanded defocus [nm RMS]")
        panels[0].set_ylabel("estimated − commanded [nm RMS]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")

    return svg(f"first-tests-{target}", (10.5, 3.6), draw)


EXPERIMENT = ex.Experiment(
    "first_tests", 6, Sizes, "First test on sky, simulated",
    samples, rows, tables, checks, LISTINGS, figures,
    "Two targets, {samples} ramps of each with NCPAs of their own.", "ramps", arrays,
)  # fmt: skip
