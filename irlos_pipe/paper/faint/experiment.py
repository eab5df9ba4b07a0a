"""How faint LIFT goes with and without calibrated NCPAs (paper, Fig. "sensitivity").

As in the paper's test, bright frames of the narrow H band are dimmed and the missing noise is put back.
Every way of estimating sees the same dimmed frames, and starts from zero defocus as a closed loop would.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion, Curve, curve_of, scan
from irlos_pipe.paper.common.ramps import DEFOCUS, ObservedRamp, calibrated, observe
from irlos_pipe.paper.focus_ramp.experiment import RAMP_STREAM, SAMPLING, WAYS
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

COMPARED = ("none_3", "none_9", "published_3", "published_9", "default_3", "default_9")
SIGNAL_WAY = "default_9"  # the best model tells the noise-free signal of the frames that are dimmed
MIRROR_NM = {6: 170.0}  # diversity by the deformable secondary


@dataclass(frozen=True)
class Exposures:
    """Frames of one length and the magnitudes to which they are dimmed."""

    exposure_s: float
    magnitudes: tuple[float, ...]


@dataclass(frozen=True)
class FaintSample:
    """One set of NCPAs: a calibration cube, and bright ramps of every length of exposure.

    Attributes
    ----------
    seeing_arcsec : float
        On SPARTA's scale.
    mag_j : float
        Of cube and ramps, before dimming.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    exposures: tuple[Exposures, ...]
    offsets_nm: tuple[float, ...]
    realisations: int
    cube_frames: int
    seeing_arcsec: float
    mag_j: float = 7.1


def scenes_of(sample: FaintSample) -> tuple[Scene, list[Scene]]:
    """Calibration cube, and a ramp of every length of exposure with one frame per offset."""
    conditions = Sample(
        sample.name,
        sample.seed,
        sample.facility,
        sample.seeing_arcsec,
        "power_law",
        sample.cube_frames,
        (),
        mag_j=sample.mag_j,
    )
    cube = replace(scene_of(conditions), diversity_nm=MIRROR_NM, diversity_source="mirror", sampling=SAMPLING)
    ramps = [
        replace(
            cube,
            role="defocus_ramp",
            seed=(*sample.seed, RAMP_STREAM, place),
            frames=len(sample.offsets_nm),
            exposure_s=one.exposure_s,
            frame_rate_hz=1 / one.exposure_s,
            introduced_nm=sample.offsets_nm,
        )
        for place, one in enumerate(sample.exposures)
    ]
    return cube, ramps


def dim_and_estimate(sample: FaintSample) -> dict[str, np.ndarray]:
    """Simulate a sample and scan the magnitudes in every way of `COMPARED`.

    Returns
    -------
    dict of str to ndarray
        For every exposure time ``<s>``: ``<s>/residual_nm`` (offsets,), the mean AO residual's defocus of
        every frame; and for every way ``<s>/<way>/abs_error_nm`` (magnitudes, offsets × realisations),
        NaN where it failed, and ``<s>/<way>/crb_nm`` (magnitudes,).
    """
    cube, ramps = scenes_of(sample)
    methods = dict.fromkeys(WAYS[key].ncpa for key in COMPARED if WAYS[key].ncpa)
    knowledge = calibrated(cube, list(methods))
    found = {}
    for ramp, exposures in zip(ramps, sample.exposures, strict=True):
        exposed = expose(ramp)
        residual = exposed.zernike_nm[:, DEFOCUS - 2] - ramp.ncpa_nm[DEFOCUS]
        curves = _scans(observe(ramp, exposed, knowledge), exposures.magnitudes, sample)
        found |= {f"{exposures.exposure_s:g}/{key}": values for key, values in curves.items()}
        found[f"{exposures.exposure_s:g}/residual_nm"] = residual
    return found


def _scans(observed: ObservedRamp, magnitudes: Sequence[float], sample: FaintSample) -> dict[str, np.ndarray]:
    signal_e = observed.estimate(WAYS[SIGNAL_WAY]).result.model_e
    found = {}
    for key in COMPARED:
        curve = _scan(observed, key, signal_e, np.array(magnitudes), sample)
        found |= {f"{key}/abs_error_nm": curve.abs_error_nm, f"{key}/crb_nm": curve.crb_nm}
    return found


def _scan(
    observed: ObservedRamp, key: str, signal_e: torch.Tensor, magnitudes: np.ndarray, sample: FaintSample
) -> Curve:
    way, data = WAYS[key], observed.data
    return scan(
        ImageModel(observed.model(way), observed.effects(way)),
        data,
        signal_e,
        sample.mag_j,
        magnitudes,
        sample.realisations,
        torch.zeros(len(data.images_e), len(way.modes), dtype=torch.float64),
        Criterion(),
        sample.seed[-1],
    )


# -- all samples -----------------------------------------------------------------------------------


def pooled(
    found: Sequence[Mapping[str, np.ndarray]], exposures: Exposures, way: str, criterion: Criterion
) -> Curve:
    """Curve of one way over all samples."""
    path = f"{exposures.exposure_s:g}/{way}"
    errors = np.concatenate([one[f"{path}/abs_error_nm"] for one in found], axis=1)
    bound = np.median([one[f"{path}/crb_nm"] for one in found], axis=0)
    return curve_of(WAYS[way].modes, np.array(exposures.magnitudes), errors, bound, criterion)


def residual_floor_nm(found: Sequence[Mapping[str, np.ndarray]], exposures: Exposures) -> float:
    """Median |error| of a perfect sensor: the AO residual has defocus of its own in every frame [nm RMS]."""
    residual = np.concatenate([one[f"{exposures.exposure_s:g}/residual_nm"] for one in found])
    return float(MEDIAN_OF_NORMAL * np.sqrt(np.mean(residual**2)))
