"""How faint LIFT goes with and without calibrated NCPAs (paper, Fig. "sensitivity").

As in the paper's test, bright frames of the narrow H band are dimmed and the missing noise is put back.
Every variant of LIFT sees the same dimmed frames, and starts from zero defocus as a closed loop would.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion, Curve, curve_of, scan
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import MIRROR_DIVERSITY_NM, CubeSample
from irlos_pipe.paper.common.observation import exposure_noise, noise_of
from irlos_pipe.paper.common.ramps import (
    DEFOCUS,
    LIFT_VARIANTS,
    RAMP_STREAM,
    ObservedRamp,
    calibrated,
    methods_of,
    observe,
)
from irlos_pipe.paper.common.reads import Read, as_read
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

COMPARED = ("none_3", "none_9", "published_3", "published_9", "default_3", "default_9")
BOUNDS = ("crb_nm", "one_read_crb_nm")
SIGNAL_VARIANT = "default_9"  # the best model gives the noise-free signal of the frames that are dimmed


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
    read : Read or None
        Of which the dimmed exposures are the sum, with the light of the sky; None gives them the noise of the
        bright ones: one read without sky.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    exposures: tuple[Exposures, ...]
    offsets_nm: tuple[float, ...]
    realisations: int
    cube_frames: int
    seeing_arcsec: float
    mag_j: float
    read: Read | None = None

    def noise_of(self, ramp: Scene) -> NoiseModel | None:
        """Return the noise of dimmed exposures of a `ramp`; None is that of the bright ones."""
        if self.read is None:
            return None
        return exposure_noise(as_read(ramp, self.read)).beyond(noise_of(ramp))


def scenes_of(sample: FaintSample) -> tuple[Scene, list[Scene]]:
    """Return the calibration cube, and a ramp of every length of exposure with one frame per offset.

    The NCPAs have no defocus of their own: a sensor that does not know them measures it rightly, but errors
    count against the introduced defocus.
    """
    conditions = CubeSample(
        sample.name, sample.seed, sample.facility, sample.seeing_arcsec, sample.cube_frames, sample.mag_j
    )
    scene = conditions.scene()
    ncpa_nm = {noll: value_nm for noll, value_nm in scene.ncpa_nm.items() if noll != DEFOCUS}
    cube = replace(
        scene, ncpa_nm=ncpa_nm, diversity_nm=MIRROR_DIVERSITY_NM, diversity_source="mirror", sampling=FINE
    )
    ramps = [
        replace(
            cube,
            role="defocus_ramp",
            seed=(*sample.seed, RAMP_STREAM, index),
            frames=len(sample.offsets_nm),
            exposure_s=one.exposure_s,
            frame_rate_hz=1 / one.exposure_s,
            introduced_nm=sample.offsets_nm,
        )
        for index, one in enumerate(sample.exposures)
    ]
    return cube, ramps


def dim_and_estimate(sample: FaintSample) -> dict[str, np.ndarray]:
    """Simulate a sample and scan the magnitudes by every variant of `COMPARED`.

    Returns
    -------
    dict of str to ndarray
        For every exposure time ``<s>``: ``<s>/residual_nm`` (offsets,), the mean AO residual's defocus of
        every frame; and for every variant ``<s>/<variant>/abs_error_nm`` (magnitudes, offsets ×
        realisations), NaN where it failed, and ``<s>/<variant>/crb_nm`` and ``…/one_read_crb_nm``
        (magnitudes,).
    """
    cube, ramps = scenes_of(sample)
    knowledge = calibrated(cube, methods_of(LIFT_VARIANTS[key] for key in COMPARED))
    found: dict[str, np.ndarray] = {}
    for ramp, exposures in zip(ramps, sample.exposures, strict=True):
        exposed = expose(ramp)
        residual = exposed.zernike_nm[:, DEFOCUS - 2]
        observed = observe(ramp, exposed, knowledge)
        curves = _scans(observed, exposures.magnitudes, sample, sample.noise_of(ramp))
        found |= {f"{exposures.exposure_s:g}/{key}": values for key, values in curves.items()}
        found[f"{exposures.exposure_s:g}/residual_nm"] = residual
    return found


def _scans(
    observed: ObservedRamp, magnitudes: Sequence[float], sample: FaintSample, faint: NoiseModel | None
) -> dict[str, np.ndarray]:
    signal_e = observed.estimate(LIFT_VARIANTS[SIGNAL_VARIANT]).result.model_e
    found: dict[str, np.ndarray] = {}
    for key in COMPARED:
        curve = _scan(observed, key, signal_e, np.array(magnitudes), sample, faint)
        found |= {
            f"{key}/abs_error_nm": curve.abs_error_nm,
            f"{key}/crb_nm": curve.crb_nm,
            f"{key}/one_read_crb_nm": curve.one_read_crb_nm,
        }
    return found


def _scan(
    observed: ObservedRamp,
    key: str,
    signal_e: torch.Tensor,
    magnitudes: np.ndarray,
    sample: FaintSample,
    faint: NoiseModel | None,
) -> Curve:
    variant, data = LIFT_VARIANTS[key], observed.data
    return scan(
        ImageModel(observed.model(variant), observed.effects(variant)),
        data,
        signal_e,
        sample.mag_j,
        magnitudes,
        sample.realisations,
        torch.zeros(len(data.images_e), len(variant.modes), dtype=torch.float64),
        Criterion(np.inf, 1.0),  # the limit is that of all samples together
        sample.seed[-1],
        faint=faint,
    )


# -- all samples -----------------------------------------------------------------------------------


def pooled(
    found: Sequence[Mapping[str, np.ndarray]], exposures: Exposures, key: str, criterion: Criterion
) -> Curve:
    """Return the curve of one variant over all samples.

    Parameters
    ----------
    found : sequence of dict
        Results of `dim_and_estimate`.
    exposures : Exposures
        Those of the curve.
    key : str
        Of `LIFT_VARIANTS`.
    criterion : Criterion
        Of the limiting magnitude.
    """
    path = f"{exposures.exposure_s:g}/{key}"
    errors = np.concatenate([one[f"{path}/abs_error_nm"] for one in found], axis=1)
    bound, recorded = (np.median([one[f"{path}/{name}"] for one in found], axis=0) for name in BOUNDS)
    nolls, magnitudes = LIFT_VARIANTS[key].modes, np.array(exposures.magnitudes)
    return curve_of(nolls, magnitudes, errors, bound, recorded, criterion)


def residual_floor_nm(found: Sequence[Mapping[str, np.ndarray]], exposures: Exposures) -> float:
    """Return the median absolute error of a perfect sensor in `exposures` [nm RMS].

    The AO residual has a defocus of its own in every frame, which is among the results `found`.
    """
    residual = np.concatenate([one[f"{exposures.exposure_s:g}/residual_nm"] for one in found])
    return float(MEDIAN_OF_NORMAL * np.sqrt(np.mean(residual**2)))
