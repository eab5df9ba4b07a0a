"""From a recipe and a recording to settings and effects of the model, and frames that belong together.

Also from the effects of a calibration to those of another recording.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import erfa
import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.conventions.pupil_drawing import turned
from irlos_pipe.conventions.text import and_more
from irlos_pipe.conventions.units import MAS_PER_RAD, NM
from irlos_pipe.effects import CATALOGUE, Calibrated, Conditions, Effect, FixedEffect, SeeingHalo
from irlos_pipe.effects.base import kind_of, labels_of
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.effects.declaration import Refraction
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.effects.public_values import components
from irlos_pipe.estimate.cube import Frames, steadied
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.optics.fourier_matrices import require_resolved
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import EffectEntry, ModelConfig, refused
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.ingest.stage import recordings_from_product
from irlos_pipe.stages.model.groups import elements_of, require_one_setup


def psf_settings(
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    *,
    introduced_nm: Mapping[int, float] | None = None,
    ncpa_nm: Mapping[int, float] | None = None,
) -> PsfSettings:
    """Settings of the PSF model for one recording, whose diversity belongs to the known wavefront.

    `introduced_nm` is what was introduced in addition to the diversity, `ncpa_nm` are NCPAs to hold, see
    `KnownWavefront`. Raises `ConfigurationError` if the pupil is sampled too coarsely for the window.
    """
    acquisition = recording.acquisition
    settings = PsfSettings(
        turned(instrument.pupil, acquisition.pupil_rotation_deg),
        recording.window,
        acquisition.pixel_scale_mas,
        acquisition.spectrum,
        KnownWavefront(acquisition.diversity, introduced_nm or {}, ncpa_nm or {}),
        model.pupil_samples,
        lenslets=acquisition.lenslets,
    ).for_broad_images()
    if acquisition.lenslets > 1:
        settings = replace(settings, pupil_samples=max(settings.pupil_samples, settings.needed_samples))
    else:
        shortest_m = min(wavelength_nm for wavelength_nm, _ in acquisition.spectrum) * NM
        step_m = instrument.pupil.diameter_m / model.pupil_samples
        with refused(ConfigurationError, f"{recording.name}: model.pupil_samples {model.pupil_samples}"):
            require_resolved(max(recording.window), acquisition.pixel_scale_mas, shortest_m, step_m)
    for entry in model.entries():
        kind = CATALOGUE[entry.name]
        if issubclass(kind, LensEffect):  # without values it has the aperture of the profile
            effect = kind(instrument.facility.numerical_aperture)
            start = [one.start for one in effect.parameters]
            values = effect.values_of(**entry.values) if entry.values else start
            settings = effect.apply(torch.tensor(values, dtype=torch.float64), settings)
    return settings


def residual_band(instrument: Instrument, model: ModelConfig) -> ResidualBand:
    """Return the frequencies of the AO residual of an `instrument`; `model` may change them.

    Below 1/D there is only tip and tilt.
    """
    facility = instrument.facility
    return ResidualBand(
        1 / facility.pupil.diameter_m,
        model.cutoff_per_m or facility.cutoff_per_m,
        model.outer_scale_m or facility.outer_scale_m,
    )


def seeing_arcsec(instrument: Instrument, acquisition: Acquisition) -> float:
    """Return the seeing of a recording's `acquisition`, or the `instrument`'s typical one."""
    return acquisition.seeing_arcsec or instrument.facility.typical_seeing_arcsec


# -- recordings that belong together -----------------------------------------------------------


def used_in_time_order(ingest: Product, input_name: str) -> list[Recording]:
    """Return the used frames of the input `input_name` of `ingest`, in order of time, of one set-up."""
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    require_one_setup(recordings)
    return recordings


def pooled_frames(
    recordings: Sequence[Recording], listed: np.ndarray, settings: PsfSettings, *, steady: bool = True
) -> Frames:
    """Return the frames of recordings of one set-up; `steady` takes out the motion of a star that moves.

    `listed`, (rows, columns), are the pixels that are good by the model. Raises `InputDataError` without a
    frame.
    """
    images_e, good, noise = pooled_images(recordings)
    if not len(images_e):
        raise InputDataError(f"{recordings[0].name}: no used frame is left")
    good = good & torch.as_tensor(listed)
    if not steady or settings.lenslets > 1:
        return Frames(images_e, good, noise)
    still_e, seen, motion = steadied(images_e.numpy(), good.numpy(), noise, settings.resolution_px)
    return Frames(torch.as_tensor(still_e), torch.as_tensor(seen), noise, motion=motion)


def pooled_images(recordings: Sequence[Recording]) -> tuple[torch.Tensor, torch.Tensor, NoiseModel]:
    """Frames of all recordings one after the other, pixels good in all of them, and their mean noise."""
    images = [r.images_e for r in recordings]  # those of a single recording are not copied
    return (
        torch.as_tensor(images[0] if len(images) == 1 else np.concatenate(images)),
        torch.as_tensor(np.all([r.good for r in recordings], axis=0)),
        NoiseModel.pooled(recordings),
    )


def in_time_order(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings by time of their first frame where all have one, else in the order given."""
    starts = [recording.start_unix_s for recording in recordings]
    return (
        sorted(recordings, key=lambda r: r.start_unix_s) if np.all(np.isfinite(starts)) else list(recordings)
    )


# -- the effects of the model for a recording ------------------------------------------------------


def conditions_of(
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    highest_noll: int = HIGHEST_REPORTED_NOLL,
    *,
    introduced_nm: Mapping[int, float] | None = None,
    ncpa_wavelength_nm: float | None = None,
) -> Conditions:
    """What effects may start from for a `recording` with an `instrument` and a recipe's `model`.

    `highest_noll` is the last mode that is estimated as such; `introduced_nm` as in `psf_settings`,
    `ncpa_wavelength_nm` as in `Conditions`.
    """
    settings = psf_settings(instrument, model, recording, introduced_nm=introduced_nm)
    return Conditions(
        settings,
        residual_band(instrument, model),
        instrument.facility.residual_law,
        seeing_arcsec(instrument, recording.acquisition),
        highest_noll,
        seeing_measured=recording.acquisition.seeing_measured,
        ncpa_law=instrument.facility.ncpa_law,
        numerical_aperture=instrument.facility.numerical_aperture,
        elements=elements_of(recording.acquisition),
        ncpa_wavelength_nm=ncpa_wavelength_nm,
        refraction=refraction_of(recording.acquisition, settings.mean_nm / 1e3),
    )


def model_effects(
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    highest_noll: int = HIGHEST_REPORTED_NOLL,
    *,
    ncpa_wavelength_nm: float | None = None,
) -> list[Effect]:
    """Return the effects of the recipe's model for one recording; arguments as of `conditions_of`.

    Raises `ConfigurationError` if an effect means nothing for this recording.
    """
    conditions = conditions_of(
        instrument, model, recording, highest_noll, ncpa_wavelength_nm=ncpa_wavelength_nm
    )
    return [_effect(entry, conditions, recording.name) for entry in model.entries()]


def _effect(entry: EffectEntry, conditions: Conditions, recording_name: str) -> Effect:
    with refused(ConfigurationError, f"model.effects: {entry.name} for {recording_name}"):
        effect = _under(entry, conditions, entry.values)
        if not (entry.values or effect.parameters):
            raise ValueError("there is nothing to estimate; give its values")
        values = effect.values_of(**entry.values) if entry.values else None
    free = [one.name for one in effect.parameters] if entry.fit else ()
    return effect if values is None else FixedEffect(effect, values, free=free)


def _under(entry: EffectEntry, conditions: Conditions, public: dict[str, Any]) -> Effect:
    """The effect with the parameters that given public values, or else the recipe's options, ask for."""
    kind = CATALOGUE[entry.name]
    return kind.under(conditions, **entry.options | kind.options_for(**public))


def shown(effects: Sequence[Effect], recordings: Sequence[Conditions]) -> list[Effect]:
    """Return the `effects` that `recordings`, by their conditions, distinguish from the static wavefront."""
    return [effect for effect in effects if effect.shown_by(recordings)]


def image_effects(effects: Sequence[Effect]) -> list[Effect]:
    """Those that the model of an image contains: neither masks of pixels nor errors of the focus stage."""
    return [effect for effect in effects if effect.found_by in ("score", "frames")]


def good_pixels(effects: Sequence[Effect], window: tuple[int, int]) -> np.ndarray:
    """Return False for the bad pixels of a `window` that the model's `effects` list, (rows, columns)."""
    return np.all([np.ones(window, bool), *(effect.good_pixels(window) for effect in effects)], axis=0)


# -- handing estimated effects from one product to the next ------------------------------------


def calibrated_effects(
    product: Product,
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    calibration_seeing_arcsec: float,
    *,
    same_star: bool = False,
    ncpa_wavelength_nm: float | None = None,
) -> dict[str, FixedEffect]:
    """Return effects as `calibrate` found them, by label, for a recording taken under another seeing.

    Each effect says what it is then, see `Effect.handed_on`. What belongs to the star, its light or the
    moment stays behind, unless the recipe gives it or the recording is of the same star. `product` is that of
    the calibration, which may have found more of the instrument than what is listed; `instrument`, `model`
    and `recording` are as of `conditions_of`.
    """
    conditions = conditions_of(instrument, model, recording, ncpa_wavelength_nm=ncpa_wavelength_nm)
    known: dict[str, FixedEffect] = {}
    # brightest pixel of the modelled mean image; the mean over cubes that were reduced one by one
    models = [product.arrays[name].value for name in product.arrays if name.endswith("model_image_e")]
    brightest_e = float(np.mean([np.max(image) for image in models])) if models else float("nan")
    then = Calibrated(calibration_seeing_arcsec, brightest_e)
    entries = model.entries()
    listed = labels_of([_effect(entry, conditions, recording.name) for entry in entries])
    found_too = {name.removeprefix("effects/") for name in product.arrays if name.startswith("effects/")}
    kinds = sorted(kind_of(label) for label in found_too.difference(listed))
    entries += [EffectEntry.of(name) for name in kinds if CATALOGUE[name].instrumental]
    effects = [_effect(entry, conditions, recording.name) for entry in entries]
    for label, entry, effect in zip(labels_of(effects), entries, effects, strict=True):
        found: Effect | None = effect
        under = then
        if not effect.parameters:  # the recipe states what it is under the present seeing
            under = replace(then, seeing_arcsec=conditions.seeing_arcsec)
        elif same_star or effect.instrumental:
            found = _measured(product, label, entry, conditions)
        else:
            continue
        if found is not None:
            known[label] = found.base.handed_on(found.all_values(()).numpy(), conditions, under)
    return known


def _measured(product: Product, label: str, entry: EffectEntry, conditions: Conditions) -> Effect | None:
    """An effect at the values of a calibration; None where it has none."""
    key = f"effects/{label}"
    if key not in product.arrays or not len(product.arrays[key].value):
        return None
    effect = _under(entry, conditions, results_of(CalibrateResults, product).effects.get(label, {}))
    values, wanted = np.array(product.arrays[key].value, float), len(effect.base.parameters)
    if len(values) != wanted:
        raise InputDataError(
            f"{product.stage}: {label} has {len(values)} parameters, where this version has {wanted}; "
            "calibrate again with it"
        )
    return FixedEffect(effect, values)


# -- dispersion and the colour of the star: in every broad band on sky unless a recipe says no -------

BROAD = 0.05  # width over mean wavelength of a band from which colours matter
COST = (
    "100 mas/um that no model knows move the defocus by 20 to 70 nm, and what is found from the images "
    "instead is less certain on faint stars"
)


def with_colour(effects: Sequence[Effect], model: ModelConfig, conditions: Conditions) -> list[Effect]:
    """Return the `effects` of a recipe's `model` with dispersion and the colour of the star, both free.

    Only where the band is broad, and on sky, that is with an AO residual, by the `conditions` of the
    recording; what the recipe lists itself stays as it is.
    """
    settings = conditions.settings
    on_sky = any(effect.name == SeeingHalo.name for effect in effects)
    if not (model.colour == "auto" and on_sky and settings.span_nm > BROAD * settings.mean_nm):
        return list(effects)
    own = [AtmosphericDispersion.under(conditions), star_colour(conditions)]
    listed = {effect.name for effect in effects}
    return [*effects, *(effect for effect in own if effect.name not in listed)]


def star_colour(conditions: Conditions) -> FixedEffect:
    """Return the `spectrum` under `conditions`, its slope alone free: a star redder or bluer than stated."""
    effect = Spectrum.under(conditions)
    null = [parameter.start for parameter in effect.parameters]
    return FixedEffect(effect, null, free=["slope_per_um"])


def colour_warning(effects: Sequence[Effect], recordings: Sequence[Recording]) -> str:
    """Return the warning that `effects` with free dispersion lack the altitude of `recordings`.

    It is empty if it lacks none.
    """
    free = any(effect.name == AtmosphericDispersion.name and effect.parameters for effect in effects)
    unknown = [one.name for one in recordings if one.acquisition.altitude_deg is None]
    if not (free and unknown):
        return ""
    named = unknown[0] + and_more(unknown)
    return f"{named}: altitude_deg is not known, so atmospheric dispersion starts from none: {COST}"


# -- dispersion as it is known: altitude, air, and direction of the zenith ---------------------------

# displacement(λ) = A(λ) tan z + B(λ) tan³ z
#
# towards the zenith, with the constants of IAU SOFA's ``refco``: Saastamoinen's model of the atmosphere, and
# the refractivity of air of IAG 1999.

UNKNOWN_MAS_PER_UM = 300.0  # what nothing corrects 60° from the zenith, at 1.4 µm
UNSURE, LEAST_MAS_PER_UM = 0.1, 5.0  # error of what is computed: this part of it, and at least so much
LEFT = 0.2  # part of the dispersion that a corrector may leave
STEP_UM = 0.01  # of the finite difference over the wavelength
LOWEST_DEG = 10.0  # altitude below which the formula errs


def refraction_of(acquisition: Acquisition, mean_um: float) -> Refraction:
    """Return what is to be expected of dispersion at the mean wavelength of an `acquisition`, `mean_um`."""
    size = _size_mas_per_um(acquisition, mean_um)
    if size is None:
        return Refraction((0.0, 0.0), UNKNOWN_MAS_PER_UM)
    if acquisition.dispersion_corrected:
        return Refraction((0.0, 0.0), LEFT * size + LEAST_MAS_PER_UM)
    if acquisition.zenith_angle_deg is None:
        return Refraction((0.0, 0.0), max(size, UNKNOWN_MAS_PER_UM))
    x, y = components(size, acquisition.zenith_angle_deg + 180)  # longer waves lie away from the zenith
    return Refraction((x, y), UNSURE * size + LEAST_MAS_PER_UM)


def _size_mas_per_um(acquisition: Acquisition, mean_um: float) -> float | None:
    """Return how far refraction moves light per µm at the mean wavelength; None where it is not known."""
    air = acquisition.pressure_hpa, acquisition.temperature_c, acquisition.humidity_percent
    pressure, temperature, humidity = (float("nan") if value is None else value for value in air)
    altitude = acquisition.altitude_deg or 0.0
    if altitude < LOWEST_DEG or not np.isfinite([pressure, temperature, humidity]).all():
        return None
    ends = [
        refraction_mas(altitude, pressure, temperature, humidity, mean_um + step)
        for step in (-STEP_UM, STEP_UM)
    ]
    return (ends[0] - ends[1]) / (2 * STEP_UM)


def refraction_mas(
    altitude_deg: float,
    pressure_hpa: float,
    temperature_c: float,
    humidity_percent: float,
    wavelength_um: float,
) -> float:
    """Return by how much light of one wavelength is raised towards the zenith [mas].

    The altitude is at least `LOWEST_DEG`; pressure, temperature and humidity are those at the telescope.
    """
    a, b = erfa.refco(pressure_hpa, temperature_c, humidity_percent / 100, wavelength_um)
    tangent = np.tan(np.pi / 2 - np.deg2rad(altitude_deg))
    return float((a * tangent + b * tangent**3) * MAS_PER_RAD)
