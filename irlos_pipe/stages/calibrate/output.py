"""What stage `calibrate` reports of its estimates: arrays, results, checks, summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects.public_values import measured, rows_of
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.frames.recording import Acquisition
from irlos_pipe.optics.image_quality import correlations
from irlos_pipe.product.product import Quantity, declared
from irlos_pipe.stages.base import StageOutput
from irlos_pipe.stages.calibrate.quality import Limits, checks_of, motion_line
from irlos_pipe.stages.calibrate.results import ARRAYS, CalibrateResults, Estimate, Tail, Twin
from irlos_pipe.stages.model.untested import CUBES_IN_SHORT, FAINT_VANES, untested_by_cubes

LABEL_WIDTH = 24  # of what stands before numbers in lines for the terminal; the longest effect has 22


def joint_output(
    limits: Limits,
    result: Calibration,
    others: Sequence[Calibration],
    seeing_arcsec: float,
    acquisition: Acquisition,
) -> StageOutput:
    """Return the output of one estimate from all recordings.

    Parameters
    ----------
    limits : Limits
    result : Calibration
        The estimate that is adopted.
    others : sequence of Calibration
        Estimates with the methods to compare.
    seeing_arcsec : float
        Seeing of the first recording.
    acquisition : Acquisition
        How it was taken.
    """
    twin = result.twin
    results = CalibrateResults(
        **estimate_keys(result),
        effects=result.effects,
        effects_sigma=result.effects_sigma,
        seeing_arcsec=seeing_arcsec,
        wavelength_nm=acquisition.wavelength_nm,
        twin=None if twin is None else Twin(**asdict(twin), preferred=twin.preferred),
        untested=untested_by_cubes(acquisition.diversity, not_told(result)),
        compare=[Estimate(**estimate_keys(other)) for other in others],
    )
    summary = _summary(result, others)
    return StageOutput(arrays_of(result), results, checks_of(limits, result), summary=summary)


def not_told(result: Calibration) -> str:
    """Return why a `result` does not tell whether the images are mirrored; empty where it does."""
    return "" if result.mirrored is not None and result.mirrored.tells else FAINT_VANES


def reported(nolls: Sequence[int]) -> slice:
    """Return the positions of the reported modes among rising Noll indices `nolls`."""
    return slice(0, sum(noll <= HIGHEST_REPORTED_NOLL for noll in nolls))


def wfe_nm(nolls: Sequence[int], zernike_nm: np.ndarray) -> float:
    """Return the RMS [nm] of the reported modes.

    Parameters
    ----------
    nolls : sequence of int
    zernike_nm : ndarray, (modes,)
        Coefficients, or their standard errors, which gives the expected total error.
    """
    return float(np.sqrt(np.sum(zernike_nm[reported(nolls)] ** 2)))


def by_noll(nolls: Sequence[int], values: np.ndarray) -> dict[int, float]:
    """Return the `values` of the reported modes by their index; `nolls` has that of every value."""
    own = reported(nolls)
    return dict(zip(nolls[own], values[own].tolist(), strict=True))


def estimate_keys(result: Calibration) -> dict[str, Any]:
    """Return the keys of `Estimate`."""
    return {
        "method": result.options.method,
        "zernike_nm": by_noll(result.nolls, result.zernike_nm),
        "sigma_nm": by_noll(result.nolls, result.sigma_nm),
        "wfe_nm": wfe_nm(result.nolls, result.zernike_nm),
        "wfe_sigma_nm": wfe_nm(result.nolls, result.sigma_nm),
        "frames": len(result.frames_nm),
        "errors_from": result.errors_from,
        "seconds": round(result.seconds, 3),
        "chi2_nu": result.chi2_nu,
        "nominal_chi2_nu": result.nominal.value,
        "nominal_chi2_nu_sigma": result.nominal.sigma,
        "loss": result.options.loss,
        "optimiser": result.options.optimiser,
        "modes_estimated": len(result.nolls),
        "all_zernike_nm": dict(zip(result.nolls, result.zernike_nm.tolist(), strict=True)),
        "tail": _tail(result),
        "status": counts(result.frame_status),
    }


def _tail(result: Calibration) -> Tail | None:
    """The law of the modes beyond the closed basis, and their RMS."""
    if result.tail is None:
        return None
    beyond = np.asarray(result.nolls) >= result.tail.first_noll
    return Tail(**asdict(result.tail), wfe_nm=float(np.linalg.norm(result.zernike_nm[beyond])))


def counts(status: Sequence[str]) -> dict[str, int]:
    """Return how often every status occurs."""
    return {name: list(status).count(name) for name in sorted(set(status))}


def arrays_of(result: Calibration, below: str = "") -> dict[str, Quantity]:
    """Return the arrays of one estimate, the `result`, in the group `below`."""
    own, left = reported(result.nolls), result.left
    values: dict[str, Any] = {} if left is None else {"left_frequency": left.at, "left_power": left.value}
    values |= {
        "noll": result.nolls,
        "zernike_nm": (result.zernike_nm, result.sigma_nm),
        "modes_nm": result.fitted_modes_nm,
        "covariance_nm2": result.covariance_nm2,
        "correlation": correlations(result.covariance_nm2[own, own]),
        "frames_nm": result.frames_nm,
        "frame_status": np.array(result.frame_status, dtype=object),
        "iterations": result.iterations,
        "mean_image_e": (result.mean_image_e, result.sigma_image_e),
        "model_image_e": result.model_image_e,
        **{f"effects/{name}": parameters for name, parameters in result.effect_values.items()},
    }
    return declared(ARRAYS, values, below=below)


def effect_lines(effects: dict[str, dict], sigma: dict[str, dict] | None = None) -> list[str]:
    """Return one line per effect, with the errors `sigma` where there are any."""
    errors = sigma or {}
    return [
        f"  {name:{LABEL_WIDTH}s}"
        + ", ".join(f"{key} {value:.4g}" for key, value in rows_of(measured(values, errors.get(name, {}))))
        for name, values in effects.items()
    ]


def _summary(result: Calibration, others: Sequence[Calibration]) -> list[str]:
    wfe, sigma = wfe_nm(result.nolls, result.zernike_nm), wfe_nm(result.nolls, result.sigma_nm)
    last = result.nolls[reported(result.nolls)][-1]
    few = ["  errors from the noise model and the misfit: too few frames to show their scatter"]
    return [
        f"NCPA            {wfe:.1f} ± {sigma:.1f} nm RMS in Noll 2–{last} "
        f"({result.options.method}, {result.seconds:.1f} s, χ²/ν {result.chi2_nu:.2f}, "
        f"nominal {result.nominal.value:.2f})",
        *(few if result.errors_from != "frames" else []),
        *([] if result.motion is None else [f"  {motion_line(result.motion)}"]),
        *_tail_lines(result),
        *effect_lines(result.effects, result.effects_sigma),
        *(
            f"  beside: {wfe_nm(other.nolls, other.zernike_nm):.1f} nm RMS ({other.options.method}, "
            f"{other.seconds:.1f} s, χ²/ν {other.chi2_nu:.2f})"
            for other in others
        ),
        CUBES_IN_SHORT,
    ]


def _tail_lines(result: Calibration) -> list[str]:
    tail = _tail(result)
    if tail is None:
        return []
    return [
        f"  {f'Noll {tail.first_noll}–{result.nolls[-1]}':{LABEL_WIDTH}s}{tail.wfe_nm:.1f} nm RMS, "
        f"law {tail.amplitude_nm:.2g} nm each, as order^{-tail.slope:.1f}"
    ]
