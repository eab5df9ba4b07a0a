"""Stage `modes`: how strong the modes are (paper, appendix A), and how many to estimate (appendix B)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.estimate.mode_law import ModeLaw, ModeScatter, fit_mode_law, mode_scatter
from irlos_pipe.estimate.mode_number import MIN_FRAMES, Choice, ModeScan, choose, scan_mode_numbers
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Quantity
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.config import Config as CalibrateConfig
from irlos_pipe.stages.calibrate.input import cube_input
from irlos_pipe.stages.calibrate.per_recording import CubeEstimate, cube_estimates
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.modes.config import Config
from irlos_pipe.stages.modes.results import LawRow, ModesResults, NumberScan

MIN_MODES = 4


def run(ctx: StageContext[Config]) -> StageOutput:
    """Fit a law to the scatter of the modes, and try several numbers of modes."""
    cubes = cube_estimates(ctx.products["calibrate"])
    if not cubes:
        raise ConfigurationError("modes needs the cubes one by one: set calibrate.each to true")
    scatter = _scatter(cubes, ctx.config.same_ncpas)
    fitted = _fitted(scatter, ctx.config.law_highest_noll)
    start = ctx.instrument.facility.ncpa_law
    laws = {
        "estimates": fit_mode_law(scatter, fitted, start, remove_noise=False),
        "ncpas": fit_mode_law(scatter, fitted, start, remove_noise=True),
    }
    arrays = _scatter_arrays(cubes, scatter, laws)
    lines = _law_lines(scatter.draws, int(fitted.sum()), laws)
    scans, numbers = _scans(ctx), None
    if scans:
        choice = choose(np.concatenate([scan.misfit for scan in scans], axis=1))
        arrays |= _scan_arrays(scans, choice)
        numbers = _numbers(scans, choice)
        lines += _number_lines(numbers)
    else:
        lines.append(f"  number of modes not tried: no cube has {MIN_FRAMES} used frames")
    results = ModesResults(
        method=results_of(CalibrateResults, ctx.products["calibrate"]).method,
        cubes=len(cubes),
        draws=scatter.draws,
        laws={name: LawRow.of(law) for name, law in laws.items()},
        numbers=numbers,
    )
    return StageOutput(arrays, results, summary=lines)


# -- appendix A ----------------------------------------------------------------------------------


def _scatter(cubes: list[CubeEstimate], same_ncpas: bool) -> ModeScatter:
    zernike_nm, sigma_nm = (np.stack([getattr(c, key) for c in cubes]) for key in ("zernike_nm", "sigma_nm"))
    if same_ncpas:
        zernike_nm = zernike_nm.mean(axis=0, keepdims=True)
        sigma_nm = np.sqrt(np.mean(sigma_nm**2, axis=0, keepdims=True) / len(cubes))
    return mode_scatter(cubes[0].nolls, zernike_nm, sigma_nm)


def _fitted(scatter: ModeScatter, highest_noll: int | None) -> np.ndarray:
    """Modes the law is fitted to: no tip and tilt."""
    nolls = np.array(scatter.nolls)
    fitted = ~np.isin(nolls, TIP_TILT) & (nolls <= (highest_noll or nolls[-1]))
    if fitted.sum() < MIN_MODES:
        raise ConfigurationError(
            f"a law needs at least {MIN_MODES} modes beyond tilt: raise calibrate.highest_noll to "
            f"{TIP_TILT[-1] + MIN_MODES} or more"
        )
    return fitted


def _law_lines(draws: int, modes: int, laws: Mapping[str, ModeLaw]) -> list[str]:
    texts = {"estimates": "of the estimates", "ncpas": "without their errors"}
    return [
        f"Modes           std(i) = A exp(−B i) + C, i = 0 for Noll 2, "
        f"from {draws} {'draw' if draws == 1 else 'draws'} of {modes} modes",
        *(
            f"  {texts[name]}: A {law.a_nm:.0f} ± {law.sigma[0]:.0f} nm, B {law.decay:.3f} ± "
            f"{law.sigma[1]:.3f}, C {law.plateau_nm:.1f} ± {law.sigma[2]:.1f} nm"
            for name, law in laws.items()
        ),
    ]


def _scatter_arrays(
    cubes: list[CubeEstimate], scatter: ModeScatter, laws: Mapping[str, ModeLaw]
) -> dict[str, Quantity]:
    several = [cube.frames_nm for cube in cubes if len(cube.frames_nm) > 1]
    variances = [np.nanvar(one, axis=0, ddof=1) for one in several] or [np.full(len(scatter.nolls), np.nan)]
    over_frames = np.sqrt(np.mean(variances, axis=0))
    arrays = {
        "noll": Quantity(np.array(scatter.nolls), "", "Noll index"),
        "std_nm": Quantity(scatter.std_nm, "nm", "RMS over the draws, about zero", scatter.std_sigma_nm),
        "noise_nm": Quantity(scatter.noise_nm, "nm", "part of it due to the errors of the estimates"),
        "frame_std_nm": Quantity(
            over_frames, "nm", "over the frames of a cube: AO residual and noise, no NCPAs"
        ),
    }
    return arrays | {
        f"law/{name}_nm": Quantity(law(scatter.nolls), "nm", f"law of the {name}")
        for name, law in laws.items()
    }


# -- appendix B ----------------------------------------------------------------------------------


def _scans(ctx: StageContext[Config]) -> list[ModeScan]:
    """Scan of the first cubes that have enough frames."""
    stored = CalibrateConfig(**ctx.products["calibrate"].config)
    recordings = [r.accepted() for r in recordings_from_product(ctx.products["ingest"], stored.input)]
    usable = [r for r in recordings if r.frames >= MIN_FRAMES][: ctx.config.cubes]
    fits = 2 * len(ctx.config.numbers) * len(usable)
    with ctx.progress(total=fits, desc="number of modes") as bar:
        return [_scan(ctx, recording, stored, bar.update) for recording in usable]


def _scan(
    ctx: StageContext[Config],
    recording: Recording,
    stored: CalibrateConfig,
    report: Callable[[int], None],
) -> ModeScan:
    options = stored.options(ctx.instrument.facility.ncpa_law)
    cube = cube_input(ctx, [recording], options)
    return scan_mode_numbers(
        cube.frames,
        cube.settings,
        options,
        ctx.config.numbers,
        cube.effects,
        device=ctx.device,
        report=report,
    )


def _numbers(scans: Sequence[ModeScan], choice: Choice) -> NumberScan:
    highest = scans[0].highest_nolls
    return NumberScan(
        cubes=len(scans),
        highest_noll=list(highest),
        held_out_chi2_nu=np.mean([scan.misfit.mean(axis=1) for scan in scans], axis=0).tolist(),
        excess=choice.excess.tolist(),
        excess_sigma=choice.excess_sigma.tolist(),
        fitted_chi2_nu=np.mean([scan.fitted_chi2_nu for scan in scans], axis=0).tolist(),
        change_nm=_rms_over_cubes(_changes_nm(scans, choice.recommended)).tolist(),
        halves_nm=_rms_over_cubes([scan.halves_nm for scan in scans]).tolist(),
        best=highest[choice.best],
        recommended=highest[choice.recommended],
    )


def _changes_nm(scans: Sequence[ModeScan], index: int) -> Iterator[np.ndarray]:
    """RMS difference from the estimate with one of the numbers, (numbers,) per cube."""
    for scan in scans:
        yield np.sqrt(np.sum((scan.mean_nm - scan.mean_nm[index]) ** 2, axis=1))


def _rms_over_cubes(values: Iterable[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.square(list(values)), axis=0))


def _number_lines(numbers: NumberScan) -> list[str]:
    index = numbers.highest_noll.index(numbers.recommended)
    return [
        f"  {numbers.recommended - 1} modes (Noll 2–{numbers.recommended}) suffice for unseen frames: "
        f"χ²/ν {numbers.held_out_chi2_nu[index]:.3f}, smallest with Noll {numbers.best}"
    ]


def _scan_arrays(scans: Sequence[ModeScan], choice: Choice) -> dict[str, Quantity]:
    return {
        "numbers/highest_noll": Quantity(np.array(scans[0].highest_nolls), "", "modes Noll 2 to this"),
        "numbers/noll": Quantity(np.array(scans[0].nolls), "", "modes that are compared"),
        "numbers/zernike_nm": Quantity(
            np.stack([scan.zernike_nm for scan in scans]), "nm", "estimates (cube, number, half, mode)"
        ),
        "numbers/misfit": Quantity(
            np.stack([scan.misfit for scan in scans]), "", "χ²/ν of unseen frames (cube, number, block)"
        ),
        "numbers/excess": Quantity(choice.excess, "", "held-out χ²/ν above the least", choice.excess_sigma),
    }
