"""The random instrument: what is not as told, and by how much.

Quantities with a sign are uniform within their limits; the others have their size in every draw. Directions,
places and patterns are random.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.diagnose_suite import mild
from benchmarks.diagnose_suite.hidden import second_image_place
from benchmarks.diagnose_suite.settings import Setting
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.instrument.instrument import load_instrument

DIVERSITY_NM = 10.0
FILTER_NM, FILTER_NOLLS = 30.0, range(4, 16)  # RMS of all modes together
STARS_K = (3000.0, 10_000.0)
PLANCK_UM_K = 14_387.77  # hc/k
# Names of the errors, for leaving one of them out; several share a section of a spec.
ERRORS = (
    "obscuration",
    "stop",
    "vanes",
    "plate_scale",
    "band",
    "colour",
    "diversity",
    "filter",
    "residual",
    "flat",
    "tail",
    "ghost",
)


def drawn_errors(setting: Setting, rng: np.random.Generator) -> dict[str, dict[str, dict[str, Any]]]:
    """Draw an instrument.

    Parameters
    ----------
    setting : Setting
        Of the recordings: how wide the window is.
    rng : numpy.random.Generator

    Returns
    -------
    dict
        By the names of `ERRORS`: keys of a simulation spec, by section; those of effects as ``effects.NAME``.
    """
    facility = load_instrument("irlos").facility
    angle = rng.uniform(0, 2 * np.pi)
    stop_m = {"dx_m": float(mild.STOP_M * np.cos(angle)), "dy_m": float(mild.STOP_M * np.sin(angle))}
    flat = {"flat_error_rms": mild.FLAT, "pattern_seed": int(rng.integers(2**31))}
    law = dict(mild.LAWS[rng.integers(len(mild.LAWS))])
    outer_scale_m = float(facility.outer_scale_m * rng.choice(mild.OUTER_SCALES))
    return {
        "obscuration": {
            "pupil": {"obscuration_m": facility.pupil.obscuration_m * (1 + _within(mild.OBSCURATION, rng))}
        },
        "stop": {"effects.pupil_misregistration": stop_m},
        "vanes": {"effects.pupil_misregistration": {"rotation_deg": _within(mild.VANES_DEG, rng)}},
        "plate_scale": {"effects.plate_scale": {"fraction": _within(mild.PLATE_SCALE, rng)}},
        "band": {"effects.spectrum": {"wavelength_nm": NARROW_H.centre_nm + _within(mild.BAND_NM, rng)}},
        "colour": {"effects.spectrum": {"slope": _colour_per_um(rng)}},
        "diversity": {"effects.diversity_error": {"nm": _within(DIVERSITY_NM, rng)}},
        "filter": {"effects.filter_ncpa": {"zernike_nm": _filter_nm(rng)}},
        "residual": {"sky": {**law, "outer_scale_m": outer_scale_m}},
        "flat": {"detector": flat},
        "tail": {"ncpa": {"tail_nm": mild.TAIL_NM, "tail_nolls": list(mild.TAIL_NOLLS)}},
        "ghost": {
            "effects.ghost": {
                "flux_ratio": mild.GHOST,
                **second_image_place(rng, setting),
                "defocus_nm": _within(mild.GHOST_DEFOCUS_NM, rng),
            }
        },
    }


def _within(limit: float, rng: np.random.Generator) -> float:
    return float(rng.uniform(-limit, limit))


def _colour_per_um(rng: np.random.Generator) -> float:
    """Relative change of the photons per µm in the band, of a black body as hot as a star."""
    temperature_k = np.exp(rng.uniform(*np.log(STARS_K)))
    wavelength_um = NARROW_H.centre_nm / 1000
    x = PLANCK_UM_K / (wavelength_um * temperature_k)
    return float((x / -np.expm1(-x) - 4) / wavelength_um)


def _filter_nm(rng: np.random.Generator) -> dict[int, float]:
    values = rng.standard_normal(len(FILTER_NOLLS))
    values *= FILTER_NM / np.linalg.norm(values)
    return dict(zip(FILTER_NOLLS, values.tolist(), strict=True))
