"""Error of Noll 2–30 against the number of estimated modes (paper, appendix B)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.mode_number import choose, fit_mode_numbers, scan_mode_numbers
from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.reads import Read, as_read
from irlos_pipe.paper.common.variants import DEFAULT, Variant

LIFT = "lift_avg"


@dataclass(frozen=True)
class NumberSample:
    """One cube and the fits made to it.

    Attributes
    ----------
    cube : CubeSample
        Its `mag_j` is not used.
    highest_nolls : tuple of int
        Modes Noll 2 to each of these are estimated.
    magnitudes : mapping of str to tuple of float
        J magnitudes for every method.
    frames : mapping of str to int
        Frames that a method is given.
    read : Read or None
        Of which exposures are the sum, with the light of the sky; None: one read without sky.
    """

    cube: CubeSample
    highest_nolls: tuple[int, ...]
    magnitudes: Mapping[str, tuple[float, ...]]
    frames: Mapping[str, int]
    read: Read | None = None

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name


def errors_by_number(sample: NumberSample) -> dict[str, np.ndarray]:
    """Simulate a cube, dim it, and estimate few and many modes.

    Returns
    -------
    dict of str to ndarray
        ``<method>/error_nm``, (magnitudes, numbers): Δ-WFE in Noll 2–30; ``recommended_noll``, the number
        that held-out frames recommend to the default at its first magnitude, and ``held_out``, (numbers,),
        the misfit they show.
    """
    cube = ObservedCube.of(as_read(sample.cube.scene(), sample.read))
    numbers = {
        f"{method}/error_nm": np.array(
            [_errors_nm(sample, cube.dimmed(mag_j), method) for mag_j in magnitudes]
        )
        for method, magnitudes in sample.magnitudes.items()
    }
    bright = cube.dimmed(sample.magnitudes[DEFAULT][0])
    options = _variant(DEFAULT).options_with(bright.scene.facility.ncpa_law)
    scan = scan_mode_numbers(bright.frames, bright.settings, options, sample.highest_nolls, bright.effects)
    return numbers | {
        "recommended_noll": np.array(scan.highest_nolls[choose(scan.misfit).recommended]),
        "held_out": scan.misfit.mean(axis=1),
    }


def _errors_nm(sample: NumberSample, cube: ObservedCube, method: str) -> list[float]:
    """Δ-WFE of one method at one magnitude for every number of modes."""
    own = cube.first(sample.frames[method])
    return [own.modes_delta_nm(fit) for fit in _fits(own, method, sample.highest_nolls)]


def _fits(cube: ObservedCube, method: str, highest_nolls: tuple[int, ...]) -> list[Calibration]:
    """The default begins every number of modes from the one before; the published methods begin from none."""
    variant = _variant(method)
    if method == DEFAULT:
        options = variant.options_with(cube.scene.facility.ncpa_law)
        return fit_mode_numbers(cube.frames, cube.settings, options, highest_nolls, cube.effects)
    return [
        cube.calibrated(replace(variant, options=replace(variant.options, highest_noll=highest)))
        for highest in highest_nolls
    ]


def _variant(method: str) -> Variant:
    """The default has its prior; the others have none, as published."""
    return Variant(method, CalibrationOptions(method), prior=method == DEFAULT)
