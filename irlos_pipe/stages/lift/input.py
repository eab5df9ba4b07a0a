"""What `lift` and `sensitivity` both need: the frames of the ramp, the model with the NCPAs, the effects."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.effects import Effect
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.effects.wavefront import BROAD_NM, ChromaticNcpa, FilterNcpa
from irlos_pipe.estimate.lift_errors import FrameErrors
from irlos_pipe.estimate.ramp_fit import RampData, RampFit, ramp_effects, start_from_defocus
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.product.results import Observed, results_of
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import IngestResults
from irlos_pipe.stages.lift.stage import OWN, Config, size_nm_of
from irlos_pipe.stages.model.effects import (
    calibrated_effects,
    conditions_of,
    good_pixels,
    image_effects,
    model_effects,
    pooled_images,
    psf_settings,
    used_in_time_order,
    with_colour,
)
from irlos_pipe.stages.model.groups import require_ramp


@dataclass(frozen=True)
class Ramp:
    """A ramp ready for estimation."""

    recordings: list[Recording]  # used frames only, in order of time
    data: RampData  # all frames one after the other
    names: list[str]  # recording of every frame of `data`
    frame: list[int]  # its number within the recording
    commanded_nm: np.ndarray  # (frames,), from the focus stage; `data` has it unless the model knows better

    @property
    def acquisition(self) -> Acquisition:
        """How the ramp was taken."""
        return self.recordings[0].acquisition


def read_ramp(ctx: StageContext, input_name: str) -> Ramp:
    """Return all used frames of the recipe input `input_name`, in order of time; `ctx` has the products.

    Raises `InputDataError` for recordings whose role is none of `ROLES`.
    """
    recordings = used_in_time_order(ctx.products["ingest"], input_name)
    require_ramp(recordings)
    introduced_nm = np.concatenate([r.introduced_defocus_nm for r in recordings]).astype(float)
    images_e, good, noise = pooled_images(recordings)
    listed = good_pixels(model_effects(ctx.instrument, ctx.model, recordings[0]), recordings[0].window)
    data = RampData(images_e, good & torch.as_tensor(listed), noise, introduced_nm)
    names = [r.name for r in recordings for _ in range(r.frames)]
    return Ramp(recordings, data, names, [i for r in recordings for i in range(r.frames)], introduced_nm)


def calibrated_ncpa_nm(ctx: StageContext) -> dict[int, float]:
    """Return every mode estimated by `calibrate`, without the part that its effects hold.

    Raises `ConfigurationError` without the stage `calibrate`.
    """
    if "calibrate" not in ctx.products:
        raise ConfigurationError(
            "lift.calibrated needs the stage `calibrate` before it; "
            "add it to the recipe, or set lift.calibrated=false"
        )
    arrays = ctx.products["calibrate"].arrays
    return {int(n): float(v) for n, v in zip(arrays["noll"].value, arrays["modes_nm"].value, strict=True)}


def ramp_model(ctx: StageContext, ramp: Ramp, nolls: tuple[int, ...], ncpa_nm: dict[int, float]) -> LightPath:
    """Return the PSF model of a `ramp` in which `nolls` are estimated, `ncpa_nm` in the known wavefront.

    `ctx` has the instrument and the section `model` of the recipe.
    """
    settings = psf_settings(ctx.instrument, ctx.model, ramp.recordings[0], ncpa_nm=ncpa_nm)
    return light_path(settings.for_single_frames(), nolls, device=ctx.device, rough_derivatives=True)


def effects_for_lift(
    ctx: StageContext,
    recording: Recording,
    halo: str,
    object_sigma_mas: str | float,
    *,
    calibrated: bool = True,
    own_wavefront: bool = False,
) -> list[Effect]:
    """Return the effects for LIFT, see `ramp_effects`, under the conditions of the `recording`.

    A drift is left out: it belongs to the recording in which it was measured. Without `calibrated`, so are
    effects that are a part of the NCPAs; `own_wavefront` adds those that the light of the recording makes of
    it.
    """
    product = ctx.products.get("calibrate")
    found = CalibrateResults() if product is None else results_of(CalibrateResults, product)
    # a calibration need not say at which wavelength it states the NCPAs
    reference = found.wavelength_nm if calibrated and math.isfinite(found.wavelength_nm) else None
    arguments = ctx.instrument, ctx.model, recording
    listed = model_effects(*arguments, ncpa_wavelength_nm=reference)
    conditions = conditions_of(*arguments, ncpa_wavelength_nm=reference)
    listed = [e for e in listed if not isinstance(e, FilterNcpa) or e.lies_in(conditions)]
    listed = with_own_wavefront(listed, conditions) if own_wavefront else listed
    available = image_effects(with_colour(listed, ctx.model, conditions))
    available = [e for e in available if e.plane != "time" and (calibrated or not e.aberration)]
    known = {}
    if product is not None:
        seeing = found.seeing_arcsec
        known = calibrated_effects(product, *arguments, seeing, ncpa_wavelength_nm=reference)
    return ramp_effects(available, known, halo, object_sigma_mas)


def ramp_start(
    ctx: StageContext, model: LightPath, ramp: Ramp, ncpa_nm: dict[int, float], start: str
) -> torch.Tensor:
    """Return the start of every frame, (frames, modes of the `model`) [nm].

    `start` is the elongation prior, from which `ncpa_nm` are taken off, a scan of defocus, the commanded
    defocus of the `ramp`, or zero; `ctx` has the products.
    """
    if start == "scan":
        return scan_start_nm(model, ramp.data.images_e, ramp.data.good)
    defocus = ramp.commanded_nm if start == "commanded" else np.zeros(len(ramp.names))
    if start == "elongation" and "prior" in ctx.products:
        defocus = np.array(ctx.products["prior"].arrays["defocus_nm"].value, float) - ncpa_nm.get(4, 0.0)
    return start_from_defocus(model, ramp.data, defocus)


# -- what the light of a ramp adds to the calibrated wavefront ---------------------------------------

# NCPAs are calibrated in a narrow band, often with another diversity, and used in a broad one. Where the
# frames of such a ramp misfit, a wavefront of their own is fitted to all of them together and kept if it
# explains the misfit: what depends on wavelength (`chromatic_ncpa`) and what the ramp's filter or lens has
# (`filter_ncpa`). Other things that a model may lack change with the focus in another way, and are hardly
# imitated.

TURNED_DEG = 1.0  # angle of the derotator from which a calibration is of another one
ALIKE = 0.01  # relative difference of mean wavelengths up to which they are of one filter
EXCUSED = 3.0  # standard errors up to which a wavefront of filter or lens may be one of the calibration
EXPLAINED = 0.5  # part of the excess of χ²/ν to be explained: less, and the model lacks something else


def has_other_light(ctx: StageContext[Config], acquisition: Acquisition) -> bool:
    """Return whether a ramp's light passes another filter or lens than that of its calibration.

    `acquisition` says how the ramp was taken, `ctx` has the products.
    """
    config = ctx.config
    if not config.calibrated or "calibrate" not in ctx.products or config.common_modes or config.singly:
        return False
    calibrated_nm = results_of(CalibrateResults, ctx.products["calibrate"]).wavelength_nm
    own_nm, source = acquisition.wavelength_nm, acquisition.diversity_source
    others = (one.diversity_source != source for one in _calibrated_with(ctx))
    return abs(own_nm / calibrated_nm - 1) > ALIKE or any(others)


def _calibrated_with(ctx: StageContext) -> list[Observed]:
    """How the recordings of the calibration were taken."""
    cubes = ctx.products["calibrate"].config.get("input")
    rows = results_of(IngestResults, ctx.products["ingest"]).inputs
    return [one.observed for one in rows if one.input == cubes]


def turned_text(ctx: StageContext[Config], acquisition: Acquisition) -> str:
    """Return what is said of NCPAs that were calibrated at another angle of the derotator; else nothing."""
    if not ctx.config.calibrated or "calibrate" not in ctx.products:
        return ""
    own_deg = acquisition.derotator_angle_deg
    angles = sorted({one.derotator_angle_deg for one in _calibrated_with(ctx)})
    apart = [math.remainder(angle - own_deg, 360.0) for angle in angles]
    if not any(abs(angle) > TURNED_DEG for angle in apart):
        return ""
    there = ", ".join(f"{angle:g}°" for angle in angles)
    return (
        f"the ramp was taken at {own_deg:g}° of the derotator, its calibration at {there}: of the NCPAs the "
        "part before it is turned"
    )


def with_own_wavefront(effects: Sequence[Effect], conditions: Conditions) -> list[Effect]:
    """Return the `effects` with those that make the wavefront of the ramp's own light, where they lack them.

    `conditions` are those of the ramp.
    """
    listed = {effect.name for effect in effects}
    broad = conditions.settings.span_nm > BROAD_NM
    own = [kind.under(conditions) for kind in OWN if broad or kind is not ChromaticNcpa]
    return [*effects, *(effect for effect in own if effect.name not in listed)]


def explains(before: FrameErrors, after: FrameErrors) -> bool:
    """Return whether a fit `after` explains what another one `before` it misses."""
    return after.excess <= EXPLAINED * before.excess


def older_text(fit: RampFit, calibration_nm: float) -> str:
    """Return what a wavefront of filter or lens in a `fit` says that errors do not excuse; else nothing.

    `calibration_nm` is the error of the calibrated wavefront [nm RMS].
    """
    if FilterNcpa.name not in fit.effects:
        return ""
    size_nm = size_nm_of(fit.effects[FilterNcpa.name][FilterNcpa.table])
    own_nm = size_nm_of(fit.sigma.get(FilterNcpa.name, {}).get(FilterNcpa.table, {}))
    error_nm = float(np.hypot(own_nm, calibration_nm))
    if size_nm < EXCUSED * error_nm:
        return ""
    return (
        f"the ramp's own light adds {size_nm:.0f} ± {error_nm:.0f} nm RMS to the calibrated wavefront: the "
        "calibration is not of this time, unless filter or lens differ by so much"
    )
