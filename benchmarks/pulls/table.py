"""Pulls of many cases as a table: quoted errors hold where the RMS of error over quoted error is one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.pages import put
from benchmarks.pulls.cases import SEEINGS_ARCSEC, SHAPES

PAGE = Path(__file__).parents[2] / "docs" / "performance.md"
DRAWS, SEED = 2000, 1
HEAD = (
    "| cubes | | error | quoted | pull | χ² of the covariance | ramp: error | quoted | pull | of its mean |"
    "\n|---|---|---|---|---|---|---|---|---|---|"
)


def table(outcomes: Sequence[dict]) -> str:
    """Return the pulls of `outcomes`, by seeing, by shape of the residual, and of all."""
    groups: list[tuple[str, Callable[[dict], bool]]] = [
        *((f"{seeing:g}″", lambda one, s=seeing: one["seeing_arcsec"] == s) for seeing in SEEINGS_ARCSEC),
        *((shape.replace("_", " "), lambda one, s=shape: one["shape"] == s) for shape in SHAPES),
        ("**all**", lambda one: True),
    ]
    rows = ((name, [one for one in outcomes if chosen(one)]) for name, chosen in groups)
    return "\n".join([HEAD, *(_row(name, some) for name, some in rows if some)])


def _row(name: str, some: Sequence[dict]) -> str:
    cubes, ramps = [one["cube"] for one in some], [one["ramp"] for one in some]
    chi2 = np.mean([one["chi2"] / len(one["error_nm"]) for one in cubes])
    cells = [
        str(len(some)),
        name,
        f"{_total(cubes, 'error_nm'):.1f} nm",
        f"{_total(cubes, 'sigma_nm'):.1f} nm",
        _with_interval(cubes),
        f"{chi2:.2f}",
        f"{_rms(ramps, 'error_nm'):.1f} nm",
        f"{_rms(ramps, 'sigma_nm'):.1f} nm",
        _with_interval(ramps),
        f"{np.sqrt(np.mean([_optics_pull(one) ** 2 for one in ramps])):.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _optics_pull(ramp: dict) -> float:
    """Mean error of the frames of a ramp, which the optics share, over what is quoted for it."""
    error = np.array(ramp["error_nm"])
    own = np.hypot(ramp["instant_nm"], np.array(ramp["photon_nm"])) / np.sqrt(len(error))
    return float(error.mean() / np.sqrt(np.mean(np.array(ramp["optics_nm"]) ** 2 + own**2)))


def _total(cubes: Sequence[dict], key: str) -> float:
    """RMS over the cubes of the sum in quadrature over their modes."""
    return float(np.sqrt(np.mean([np.sum(np.square(one[key])) for one in cubes])))


def _rms(ramps: Sequence[dict], key: str) -> float:
    return float(np.sqrt(np.nanmean(np.square([one[key] for one in ramps]))))


def _with_interval(some: Sequence[dict]) -> str:
    """RMS pull, with the interval of 90 % over draws of the cases."""
    squares = np.array([np.nanmean((np.array(o["error_nm"]) / np.array(o["sigma_nm"])) ** 2) for o in some])
    drawn = np.random.default_rng(SEED).integers(0, len(squares), (DRAWS, len(squares)))
    low, high = np.percentile(np.sqrt(squares[drawn].mean(axis=1)), [5, 95])
    return f"{np.sqrt(squares.mean()):.2f} ({low:.2f}–{high:.2f})"


def write_page(text: str) -> None:
    """Put the table between its marks in docs/performance.md."""
    put(PAGE, {"pulls": text})
