"""Stage `mode_statistics`: standard deviation per mode on simulated cubes (paper, appendix A)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.estimate.mode_law import ModeLaw, ModeScatter, equalised_tilts, fit_mode_law, mode_scatter
from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.ensemble import Arrays, run_samples
from irlos_pipe.paper.common.variants import PAPER_CHOICE, frames_per_method
from irlos_pipe.paper.mode_statistics.checks import checks_of
from irlos_pipe.paper.mode_statistics.experiment import (
    FIRST_FITTED,
    INTRODUCED,
    StatisticsSample,
    beyond_nm,
    estimate_modes,
)
from irlos_pipe.paper.mode_statistics.results import ModeStatisticsResults as Results
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.modes import LawRow

NAME = Results.stage
VERSION = 2
READS = ()
DEPENDS_ON = ("instrument", "seed")
TRUTH = "introduced"


class Config(StageConfig):
    """Sizes of the experiment."""

    cubes: int = Field(20, ge=2, le=1000, description="cubes, each with its own NCPAs of 50 modes")
    frames: int = Field(100, ge=10, le=10000, description="frames of a cube")
    published_frames: int = Field(
        20, ge=2, le=10000, description="the first frames, for the published method, which fits one by one"
    )
    highest_noll: int = Field(
        101, ge=INTRODUCED + 10, le=HIGHEST_NOLL, description="modes Noll 2 to this are estimated"
    )
    seeing_arcsec: float = Field(0.5, gt=0, le=5, description="seeing on SPARTA's scale")
    mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude of the star")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate many modes in every cube; scatter over the cubes and its law, per method."""
    samples = list(_samples(ctx))
    found = run_samples(estimate_modes, samples, ctx, "cubes")
    methods = samples[0].frames
    nolls = np.arange(2, ctx.config.highest_noll + 1)
    scatters = {
        TRUTH: _scatter(nolls, [one["introduced_nm"] for one in found], 0.0 * nolls),
        **{method: _estimated(nolls, found, method) for method in methods},
    }
    start = ctx.instrument.facility.ncpa_law
    laws = {method: _law(scatters[method], start, last=None) for method in methods}
    introduced = {name: _law(scatter, start, last=INTRODUCED) for name, scatter in scatters.items()}
    results = Results(
        cubes=len(found),
        modes_introduced=INTRODUCED - 1,
        modes_estimated=len(nolls),
        laws={name: LawRow.of(law) for name, law in laws.items()},
        laws_of_introduced_modes={name: LawRow.of(law) for name, law in introduced.items()},
        beyond_nm={name: beyond_nm(nolls, scatter.std_nm) for name, scatter in scatters.items()},
        error_nm={method: _errors_nm(found, method) for method in methods},
    )
    return StageOutput(
        _arrays(nolls, scatters, laws, introduced), results, checks_of(results), summary=_lines(results)
    )


def _samples(ctx: StageContext[Config]) -> Iterator[StatisticsSample]:
    config = ctx.config
    frames = frames_per_method(config.frames, config.published_frames)
    for index in range(config.cubes):
        cube = CubeSample(
            f"cube {index}",
            (ctx.seed, index),
            ctx.instrument.facility,
            config.seeing_arcsec,
            config.frames,
            config.mag_j,
        )
        yield StatisticsSample(cube, config.highest_noll, frames)


def _scatter(nolls: np.ndarray, zernike_nm: Sequence[np.ndarray], sigma_nm: np.ndarray) -> ModeScatter:
    sigma = np.broadcast_to(sigma_nm, np.shape(zernike_nm))
    return equalised_tilts(mode_scatter(nolls.tolist(), np.stack(zernike_nm), sigma))


def _estimated(nolls: np.ndarray, found: Sequence[Arrays], method: str) -> ModeScatter:
    estimates, errors = ([one[f"{method}/{key}"] for one in found] for key in ("zernike_nm", "sigma_nm"))
    return _scatter(nolls, estimates, np.stack(errors))


def _law(scatter: ModeScatter, start: NcpaLaw, last: int | None) -> ModeLaw:
    """Law of the estimates as they are, like the paper's; up to Noll `last`."""
    nolls = np.array(scatter.nolls)
    fitted = (nolls >= FIRST_FITTED) & (nolls <= (last or nolls[-1]))
    return fit_mode_law(scatter, fitted, start, remove_noise=False)


def _errors_nm(found: Sequence[Arrays], method: str) -> list[float]:
    """RMS error of every cube beyond tip and tilt, against the introduced modes."""
    wrong = np.stack([one[f"{method}/zernike_nm"] - one["introduced_nm"] for one in found])[:, 2:]
    return np.sqrt(np.sum(wrong**2, axis=1)).tolist()


def _arrays(
    nolls: np.ndarray,
    scatters: dict[str, ModeScatter],
    laws: dict[str, ModeLaw],
    introduced: dict[str, ModeLaw],
) -> dict[str, Quantity]:
    arrays = {"noll": Quantity(nolls, "", "Noll index")}
    for name, scatter in scatters.items():
        text = f"{name}: RMS over the cubes"
        arrays[f"{name}/std_nm"] = Quantity(scatter.std_nm, "nm", text, scatter.std_sigma_nm)
        arrays[f"{name}/noise_nm"] = Quantity(scatter.noise_nm, "nm", "quoted error of the estimates")
        law = laws[name] if name == PAPER_CHOICE else introduced[name]
        arrays[f"{name}/law_nm"] = Quantity(law(nolls.tolist()), "nm", "fitted law")
    return arrays


def _lines(results: Results) -> list[str]:
    lines = [f"Modes           {results.modes_estimated} estimated, {results.modes_introduced} introduced"]
    for name, law in results.laws_of_introduced_modes.items():
        lines.append(
            f"  {name:14s} A {law.A_nm:.0f} nm, B {law.B:.2f}, C {law.C_nm:.1f} nm up to Noll "
            f"{INTRODUCED}; {results.beyond_nm[name]:.1f} nm per mode beyond"
        )
    return lines
