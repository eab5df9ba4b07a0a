"""Stage `modes`: how strong the modes are (paper, appendix A), and how many to estimate (appendix B)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import nan
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import field_validator

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.modes import HIGHEST_NOLL, TIP_TILT
from irlos_pipe.product.product import declared
from irlos_pipe.product.results import DITTO, Number, ResultsPart, StageResults, item, results_of
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.calibrate.stage import CalibrateResults, cube_estimates
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig
from irlos_pipe.stages.ingest.stage import recordings_from_product

if TYPE_CHECKING:
    from irlos_pipe.estimate.mode_number import Choice, ModeLaw, ModeScan, ModeScatter

VERSION = 4
NEEDS = ("ingest", "calibrate")
ARRAYS = {
    "noll": ("", "mode", "Noll index"),
    "std_nm": ("nm ±", "mode", "RMS over the draws, about zero"),
    "noise_nm": ("nm", "mode", "part of it due to the errors of the estimates"),
    "frame_std_nm": ("nm", "mode", "over the frames of a cube: AO residual and noise, no NCPAs"),
    "law/<law>": ("nm", "mode", "law of the estimates, and of the NCPAs without their errors"),
    "numbers/highest_noll": ("", "number", "modes Noll 2 to this"),
    "numbers/noll": ("", "mode", "modes that are compared"),
    "numbers/zernike_nm": ("nm", "cube, number, half, mode", "estimates"),
    "numbers/misfit": ("", "cube, number, block", "χ²/ν of unseen frames"),
    "numbers/excess": ("±", "number", "held-out χ²/ν above the least"),
}
MIN_MODES = 4  # one more than the parameters of the law


class Config(StageConfig):
    """Settings of the mode statistics."""

    same_ncpas: bool = item(
        False, "whether the cubes have the same NCPAs, and so count as one draw of every mode"
    )
    law_highest_noll: int | None = item(
        None,
        "highest Noll mode that the law is fitted to, from 4 on; null: all estimated modes",
        ge=7,
        le=HIGHEST_NOLL,
    )
    numbers: tuple[int, ...] = item((21, 36, 45, 55, 66, 78, 91, 105), "highest Noll modes to try")
    cubes: int = item(4, "number of cubes, from the first, that the numbers of modes are tried on", ge=0)

    @field_validator("numbers")
    @classmethod
    def _rising(cls, numbers: tuple[int, ...]) -> tuple[int, ...]:
        if (
            len(numbers) < 2
            or list(numbers) != sorted(set(numbers))
            or numbers[0] < 4
            or numbers[-1] > HIGHEST_NOLL
        ):
            raise ValueError(f"give at least two rising numbers between 4 and {HIGHEST_NOLL}")
        return numbers


class LawRow(ResultsPart):
    """A fitted law std(i) = A exp(−B i) + C, i = 0 for Noll 2, see `estimate.mode_number.ModeLaw`."""

    A_nm: Number = item(nan, "Amplitude A of the law, and its standard error [nm RMS].")
    B: Number = item(nan, "Decay B per mode, and its standard error.")
    C_nm: Number = item(nan, "Plateau C, and its standard error [nm RMS].")
    A_sigma_nm: Number = item(nan, "Amplitude A of the law, and its standard error [nm RMS].")
    B_sigma: Number = item(nan, "Decay B per mode, and its standard error.")
    C_sigma_nm: Number = item(nan, "Plateau C, and its standard error [nm RMS].")
    deviance_nu: Number = item(
        nan, "Deviance over what draws from the law would give; near 1 where it holds."
    )
    plateau_noll: int | None = item(
        None, "Noll index from which the exponential is below a tenth of the plateau."
    )

    @classmethod
    def of(cls, law: ModeLaw) -> LawRow:
        """Return the parameters of a `law` with their errors."""
        sigma = dict(zip(("A_sigma_nm", "B_sigma", "C_sigma_nm"), law.sigma, strict=True))
        return cls.filled_from(law, A_nm=law.a_nm, B=law.decay, C_nm=law.plateau_nm, **sigma)


class NumberScan(ResultsPart):
    """Fits with several numbers of modes; lists are over `highest_noll`."""

    cubes: int = item(0, "Cubes that the numbers were tried on.")
    highest_noll: list[int] = item([], "Highest Noll index of each fit.")
    held_out_chi2_nu: list[Number] = item([], "Reduced χ² of unseen frames, and of those fitted.")
    excess: list[Number] = item([], "Held-out χ²/ν above the least, with its error.")
    excess_sigma: list[Number] = item([], DITTO)
    fitted_chi2_nu: list[Number] = item([], "Reduced χ² of unseen frames, and of those fitted.")
    change_nm: list[Number] = item(
        [], "RMS difference of the reported modes from the estimate with the recommended number."
    )
    halves_nm: list[Number] = item([], "Error from the difference of the two halves of the frames.")
    best: int = item(
        0, "Highest Noll index with the least χ², and the least one that is as good within the error."
    )
    recommended: int = item(0, DITTO)


class ModesResults(StageResults):
    """Strength of the modes and their number."""

    stage: ClassVar[str] = "modes"
    method: str = item("", "How the modes of the cubes were estimated.")
    cubes: int = item(0, "Cubes that the law was fitted to.")
    draws: int = item(0, "Independent sets of NCPAs among the `cubes`.")
    laws: dict[str, LawRow] = item(
        {}, "``estimates`` as they are, and ``ncpas`` without the errors of the estimates."
    )
    numbers: NumberScan | None = item(None, "None where no cube has frames enough.")


Results = ModesResults


def run(ctx: StageContext[Config]) -> StageOutput:
    """Fit a law to the scatter of the modes, and try several numbers of modes."""
    from irlos_pipe.estimate.mode_number import MIN_FRAMES, choose, fit_mode_law, mode_scatter

    cubes = cube_estimates(ctx.products["calibrate"], "modes")
    zernike_nm, sigma_nm = (np.stack([getattr(c, key) for c in cubes]) for key in ("zernike_nm", "sigma_nm"))
    if ctx.config.same_ncpas:
        zernike_nm = zernike_nm.mean(axis=0, keepdims=True)
        sigma_nm = np.sqrt(np.mean(sigma_nm**2, axis=0, keepdims=True) / len(cubes))
    scatter = mode_scatter(cubes[0].nolls, zernike_nm, sigma_nm)
    fitted = _fitted(scatter, ctx.config.law_highest_noll)
    start = ctx.instrument.facility.ncpa_law
    laws = {
        "estimates": fit_mode_law(scatter, fitted, start, remove_noise=False),
        "ncpas": fit_mode_law(scatter, fitted, start, remove_noise=True),
    }
    several = [cube.frames_nm for cube in cubes if len(cube.frames_nm) > 1]
    variances = [np.nanvar(one, axis=0, ddof=1) for one in several] or [np.full(len(scatter.nolls), np.nan)]
    arrays = {
        "noll": scatter.nolls,
        "std_nm": (scatter.std_nm, scatter.std_sigma_nm),
        "noise_nm": scatter.noise_nm,
        "frame_std_nm": np.sqrt(np.mean(variances, axis=0)),
        **{f"law/{name}_nm": law(scatter.nolls) for name, law in laws.items()},
    }
    lines = _law_lines(scatter.draws, int(fitted.sum()), laws)
    scans, numbers = _scans(ctx, MIN_FRAMES), None
    if scans:
        choice = choose(np.concatenate([scan.misfit for scan in scans], axis=1))
        arrays |= {
            "numbers/highest_noll": scans[0].highest_nolls,
            "numbers/noll": scans[0].nolls,
            "numbers/zernike_nm": np.stack([scan.zernike_nm for scan in scans]),
            "numbers/misfit": np.stack([scan.misfit for scan in scans]),
            "numbers/excess": (choice.excess, choice.excess_sigma),
        }
        numbers = _numbers(scans, choice)
        index = numbers.highest_noll.index(numbers.recommended)
        lines += [
            f"  {numbers.recommended - 1} modes (Noll 2–{numbers.recommended}) suffice for unseen frames: "
            f"χ²/ν {numbers.held_out_chi2_nu[index]:.3f}, smallest with Noll {numbers.best}"
        ]
    else:
        lines.append(f"  number of modes not tried: no cube has {MIN_FRAMES} used frames")
    results = ModesResults(
        method=results_of(CalibrateResults, ctx.products["calibrate"]).method,
        cubes=len(cubes),
        draws=scatter.draws,
        laws={name: LawRow.of(law) for name, law in laws.items()},
        numbers=numbers,
    )
    return StageOutput(declared(ARRAYS, arrays), results, summary=lines)


# -- appendix A ----------------------------------------------------------------------------------


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


# -- appendix B ----------------------------------------------------------------------------------


def _scans(ctx: StageContext[Config], least_frames: int) -> list[ModeScan]:
    """Scan of the first cubes that have enough frames."""
    from irlos_pipe.estimate.mode_number import scan_mode_numbers
    from irlos_pipe.stages.calibrate.work import cube_input

    stored = CalibrateConfig(**ctx.products["calibrate"].config)
    recordings = [r.accepted() for r in recordings_from_product(ctx.products["ingest"], stored.input)]
    usable = [r for r in recordings if r.frames >= least_frames][: ctx.config.cubes]
    options, numbers = stored.options(ctx.instrument.facility.ncpa_law), ctx.config.numbers
    found = []
    with ctx.progress(total=2 * len(numbers) * len(usable), desc="number of modes") as bar:
        for recording in usable:
            cube, _ = cube_input(ctx, [recording], options)
            of_cube = cube.frames, cube.settings, options, numbers, cube.own
            found.append(scan_mode_numbers(*of_cube, device=ctx.device, report=bar.update))
    return found


def _numbers(scans: Sequence[ModeScan], choice: Choice) -> NumberScan:
    highest, index = scans[0].highest_nolls, choice.recommended
    changes_nm = [np.sqrt(np.sum((one.mean_nm - one.mean_nm[index]) ** 2, axis=1)) for one in scans]
    return NumberScan(
        cubes=len(scans),
        highest_noll=list(highest),
        held_out_chi2_nu=np.mean([scan.misfit.mean(axis=1) for scan in scans], axis=0).tolist(),
        excess=choice.excess.tolist(),
        excess_sigma=choice.excess_sigma.tolist(),
        fitted_chi2_nu=np.mean([scan.fitted_chi2_nu for scan in scans], axis=0).tolist(),
        change_nm=_rms_over_cubes(changes_nm).tolist(),
        halves_nm=_rms_over_cubes([scan.halves_nm for scan in scans]).tolist(),
        best=highest[choice.best],
        recommended=highest[index],
    )


def _rms_over_cubes(values: Iterable[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.square(list(values)), axis=0))
