"""What `lift` and `sensitivity` both need: frames of the ramp, model with the NCPAs, effects; LIFT on them.

Frames are fitted as the stage's settings ask for it: jointly, or as the focus loop does it.
"""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects import Effect, expected
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.wavefront import BROAD_NM, ChromaticNcpa, FilterNcpa, HighOrderNcpa
from irlos_pipe.estimate.calibration_options import LiftOptions, NcpaPrior
from irlos_pipe.estimate.focus import NOLLS, Focus, Limits, lift_singly
from irlos_pipe.estimate.ramp_fit import RampData, RampFit, fit_ramp, ramp_effects, start_from_defocus
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.product.results import Observed, results_of
from irlos_pipe.stages.base import StageContext, refused
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import IngestResults
from irlos_pipe.stages.lift.stage import OWN, Config, size_nm_of
from irlos_pipe.stages.model.effects import (
    calibrated_effects,
    colour_warning,
    conditions_of,
    good_pixels,
    image_effects,
    model_effects,
    pooled_images,
    psf_settings,
    used_in_time_order,
    with_colour,
)
from irlos_pipe.stages.model.groups import require_ramp, turned_angles


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

    def refused(self) -> AbstractContextManager[None]:
        """Return the context in which a `ValueError` is an `InputDataError` of the ramp."""
        return refused(InputDataError, f"ramp of {len(self.recordings)} recordings")


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
    there = turned_angles((one.derotator_angle_deg for one in _calibrated_with(ctx)), own_deg)
    return there and (
        f"the frames were taken at {own_deg:g}° of the derotator, the calibration at {there}: of the NCPAs "
        "the part before it is turned; calibrate at the angle of the frames"
    )


def with_own_wavefront(effects: Sequence[Effect], conditions: Conditions) -> list[Effect]:
    """Return the `effects` with those that make the wavefront of the ramp's own light, where they lack them.

    `conditions` are those of the ramp.
    """
    listed = {effect.name for effect in effects}
    broad = conditions.settings.span_nm > BROAD_NM
    own = [kind.under(conditions) for kind in OWN if broad or kind is not ChromaticNcpa]
    return [*effects, *(effect for effect in own if effect.name not in listed)]


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


def fit_frames(
    ctx: StageContext[Config],
    ramp: Ramp,
    *,
    own_wavefront: bool = False,
    seen: np.ndarray | None = None,
    after: RampFit | None = None,
) -> RampFit:
    """Estimate every frame of the `ramp` as the settings of `lift` in `ctx` ask for it.

    With `own_wavefront` that of the ramp's light is fitted to all frames. The frames `seen`, (frames,) of
    bool, determine what all frames share, by default all of them; `after` is another fit of the ramp whose
    dispersion, colour and own wavefront are taken over and not fitted once more.
    """
    if ctx.config.singly:
        return _fit_singly(ctx, ramp)
    config, recording = ctx.config, ramp.recordings[0]
    ncpa_nm = calibrated_ncpa_nm(ctx) if config.calibrated else {}
    model = ramp_model(ctx, ramp, config.modes, ncpa_nm)
    own_wavefront |= after is not None and any(isinstance(one.base, OWN) for one in _effects_of(after))
    kept = {"calibrated": config.calibrated, "own_wavefront": own_wavefront}
    effects = effects_for_lift(ctx, recording, config.halo, config.object_sigma_mas, **kept)
    effects = effects if after is None else _with_light_of(after, effects)
    first = after is None and (not own_wavefront or config.own_wavefront == "always")
    if first and (warning := colour_warning(effects, ramp.recordings)):
        ctx.log.warning(warning)
    if config.common_modes:
        effects.append(HighOrderNcpa(config.common_modes))
    start = ramp_start(ctx, model, ramp, ncpa_nm, config.start)
    options = _options(config, ctx.instrument.facility.ncpa_law, start)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        return fit_ramp(model, ramp.data, start, options, effects, seen=seen, report=bar.update)


def _effects_of(fit: RampFit) -> Sequence[Effect]:
    return fit.model.general.effects.effects


def _with_light_of(found: RampFit, effects: list[Effect]) -> list[Effect]:
    """Effects with dispersion, colour and own wavefront held as another fit `found` them."""
    held = dict(zip(found.model.general.effects.labels, _effects_of(found), strict=True))
    light = (AtmosphericDispersion, Spectrum, *OWN)
    return [
        held.get(label, effect) if isinstance(effect.base, light) else effect
        for label, effect in zip(labels_of(effects), effects, strict=True)
        if label in held or not isinstance(effect.base, OWN)
    ]


def _options(config: Config, ncpa_law: NcpaLaw, start_nm: torch.Tensor) -> LiftOptions:
    """ML, or MAP about the start's defocus and zero for the other modes."""
    if config.estimator == "ml":
        return LiftOptions(config.noise, max_iterations=config.max_iterations, loss=config.loss)
    mean = torch.zeros_like(start_nm)
    focus = config.modes.index(4)
    mean[:, focus] = start_nm[:, focus]
    sigma_nm = NcpaPrior(ncpa_law, config.prior_scale).sigma_nm(config.modes)
    return LiftOptions(config.noise, mean, sigma_nm, config.max_iterations, config.loss)


# -- one frame at a time: the sensor that a calibration makes ----------------------------------------


def single_frame_model(ctx: StageContext[Config], recording: Recording) -> ImageModel:
    """Return the model of single frames with tip, tilt and defocus, everything else as calibrated.

    Effects that are neither calibrated nor given values are taken as expected. `ctx` is as in `fit_frames`;
    of the `recording` only acquisition and window matter.

    Raises `ConfigurationError` for a recording of a 2x2 mode, whose images are not tabulated.
    """
    config = ctx.config
    ncpa_nm = calibrated_ncpa_nm(ctx) if config.calibrated else {}
    settings = psf_settings(ctx.instrument, ctx.model, recording, ncpa_nm=ncpa_nm)
    if settings.lenslets > 1:
        raise ConfigurationError(
            f"{recording.name}: frames of 2x2 modes cannot be measured singly; set lift.singly=false"
        )
    psf = PsfModel(settings.for_single_frames(), NOLLS)
    kernel = config.object_sigma_mas
    effects = effects_for_lift(ctx, recording, config.halo, kernel, calibrated=config.calibrated)
    return ImageModel(psf, expected(effects))


def focus_sensor(
    model: ImageModel, good: np.ndarray, noise: NoiseModel, limits: Limits | None = None
) -> Focus:
    """Return the sensor with a `model`, `good` pixels, `noise` of one read and `limits`, see `Focus`.

    Raises `ConfigurationError` if the images of such a model cannot be tabulated.
    """
    with refused(ConfigurationError, "single frames cannot be measured with this model"):
        return Focus(model, good, noise, limits or Limits())


def _fit_singly(ctx: StageContext[Config], ramp: Ramp) -> RampFit:
    """Estimate every frame of a `ramp` by itself; `ctx` as in `fit_frames`."""
    model = single_frame_model(ctx, ramp.recordings[0])
    focus = focus_sensor(model, ramp.data.good.numpy(), ramp.data.noise)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        result = lift_singly(focus, ramp.data.images_e.numpy(), bar.update)
    start_nm = torch.full_like(result.zernike_nm, torch.nan)  # no start: every frame is scanned
    return RampFit(result, model, model.effects.describe(NOTHING), None, start_nm)
