"""Images in memory and keywords as a run takes them: recordings with side-cars, a profile, settings.

Frames are written to a folder of the caller's, so that there is one way from images to results.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.files.fits import fits
from irlos_pipe.files.validation import Origins, require_valid
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.instrument.made import MAP_FILE, made_profile
from irlos_pipe.instrument.profile import FACTS
from irlos_pipe.readers.fitsfile import require_cube
from irlos_pipe.readers.sidecar import AcquisitionKeys, DetectorKeys
from irlos_pipe.recipe.load import SECTIONS
from irlos_pipe.report.text import plural
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.model.section import ModelConfig

NEEDED = {
    "pixel_scale_mas": "mas per pixel",
    "wavelength_nm": "one wavelength, or {wavelength: weight}",
    "diversity": "the aberration introduced on purpose, {Noll: nm RMS}, {} without one",
}
DEFOCUS = "introduced_defocus_nm"  # of the first input
OWN_LISTS = (DEFOCUS, "spectrum", "filter_curve")  # whose value is a list for one recording
RECORDED = ("wavelength_nm", *AcquisitionKeys.model_fields, *DetectorKeys.model_fields)
COARSEST, NARROWEST = 4.0, 1.0  # λ/D in a pixel at most, and in a window at least: others are another unit
ROLES = {"ramp": "defocus_ramp"}  # by input; others are calibrations


class Keywords(NamedTuple):
    """What the keywords of a call say, by what it is about."""

    acquisition: dict[str, Any]  # of the recordings
    facts: dict[str, Any]  # of the instrument
    settings: dict[str, Any]  # by dotted key

    @classmethod
    def of(cls, stage: str, given: Mapping[str, Any]) -> Keywords:
        """Sort keywords; `ConfigurationError` for one that is no key, fact, section or setting."""
        found = cls({}, {}, {})
        facts = {"diameter_m": "pupil_diameter_m"} | {key: key for key in FACTS if "pupil" not in key}
        settings = {key: f"{stage}.{key}" for key in STAGES[stage].Config.model_fields if key != "input"}
        settings |= {key: f"model.{key}" for key in ModelConfig.model_fields}
        for key, value in ((key, plain(value)) for key, value in given.items() if value is not None):
            if key in RECORDED:
                found.acquisition[key] = value
            elif key in facts:
                found.facts[facts[key]] = value
            elif key in SECTIONS and isinstance(value, dict):
                found.settings.update({f"{key}.{inner}": one for inner, one in value.items()})
            elif key in settings or key in SECTIONS:
                found.settings[settings.get(key, key)] = value
            else:
                known = dict.fromkeys([*NEEDED, "pupil", *RECORDED, *facts, *settings, *SECTIONS])
                raise ConfigurationError(f"{stage}(): unknown keyword '{key}'{suggestion(key, known)}")
        return found


class Prepared(NamedTuple):
    """What a call asks for: inputs ``NAME=PATH``, settings, and the recipe that suits them."""

    inputs: list[str]
    settings: dict[str, Any]
    recipe: str


def prepared(stage: str, inputs: Mapping[str, Any], given: Mapping[str, Any], folder: Path) -> Prepared:
    """Return what a run is to read; images in memory are written to `folder`.

    Parameters
    ----------
    stage : str
        The stage whose settings may be keywords.
    inputs : mapping
        By input of the recipe: paths, arrays, mappings ``{"images": array, key: value}``, or lists of them.
    given : mapping
        The keywords of the call.

    Raises
    ------
    ConfigurationError, InputDataError
        For keywords that are unknown, wrong or missing, and for arrays that are no images.
    """
    given = dict(given)
    pupil, instrument = given.pop("pupil", None), given.pop("instrument", None)
    said = Keywords.of(stage, given)
    if instrument is not None and (pupil is not None or said.facts):
        raise ConfigurationError(f"{stage}(): give a pupil with its facts, or an instrument, not both")
    settings: dict[str, Any] = {} if instrument is None else {"instrument": str(instrument)}
    paths: list[str] = []
    arrays: dict[str, tuple[np.ndarray, dict[str, Any]]] = {}  # with their side-cars
    for name, several in inputs.items():
        first = name == next(iter(inputs))
        keys = {key: value for key, value in said.acquisition.items() if first or key != DEFOCUS}
        recordings = _recordings(several, keys)
        if not recordings:
            raise ConfigurationError(f"{stage}(): no images; give an array, or the path of a recording")
        for index, one in enumerate(recordings):
            title = name if len(recordings) == 1 else f"{name}_{index + 1}"
            if isinstance(one, (str, Path)):
                paths.append(f"{name}={one}")
                if keys:
                    settings[f"ingest.acquisition_of.{name}"] = _sidecar(stage, keys)
                continue
            paths.append(f"{name}={folder / title}.fits")
            images, own = _own(one, f"{stage}(): {title}")
            if instrument is None:
                _require(stage, keys | own)
            side = {"role": ROLES.get(name, "ncpa_calibration")}
            side |= _sidecar(stage, keys | own, index, len(recordings))
            arrays[title] = images, side
    folder.mkdir(parents=True, exist_ok=True)
    for title, (cube, side) in arrays.items():
        fits.PrimaryHDU(cube).writeto(folder / f"{title}.fits", overwrite=True)
        (folder / f"{title}.yaml").write_text(yaml_text(side))
    if pupil is not None or said.facts or (arrays and instrument is None):
        path = _profile(stage, pupil, said.facts, folder)
        settings["instrument"] = str(path)
        diameter_m = load_instrument(path).pupil.diameter_m
        for cube, side in arrays.values():
            _require_units(stage, cube.shape[1:], side, diameter_m)
    inside = bool(arrays) and instrument is None and "seeing_arcsec" not in said.acquisition
    if inside and stage != "diagnose":
        settings["model.effects"] = ["tip_tilt_jitter"]
    return Prepared(paths, settings | said.settings, f"{stage}_bench" if inside else stage)


def _recordings(several: Any, keys: Mapping[str, Any]) -> list[Any]:
    """The recordings of an input; images of one window are one, where no key has a value for each."""
    found = list(_flat(several))
    windows = {one.shape for one in found if isinstance(one, np.ndarray) and one.ndim == 2}
    each = any(isinstance(value, list) for key, value in keys.items() if key not in OWN_LISTS)
    alike = len(windows) == 1 and all(isinstance(one, np.ndarray) and one.ndim == 2 for one in found)
    return [np.stack(found)] if alike and not each else found


def _own(one: Any, where: str) -> tuple[np.ndarray, dict[str, Any]]:
    """The images of a recording in memory, and the keys that it has of its own."""
    one = one if isinstance(one, Mapping) else {"images": one}
    keys = {key: plain(value) for key, value in one.items() if key != "images"}
    for key in keys.keys() - set(RECORDED):
        raise ConfigurationError(f"{where}: unknown key '{key}'{suggestion(key, ['images', *RECORDED])}")
    return _cube(one.get("images"), where), keys


def _profile(stage: str, pupil: Any, facts: Mapping[str, Any], folder: Path) -> Path:
    """Write the profile of a pupil."""
    if pupil is None:
        raise ConfigurationError(
            f"{stage}(): pupil is missing: 'circle' or an amplitude map with diameter_m, "
            "{'diameter_m': 8.0, 'obscuration': 0.14}, or the name of a telescope"
        )
    content, samples = made_profile(pupil, facts)
    if samples is not None:
        fits.PrimaryHDU(samples).writeto(folder / MAP_FILE, overwrite=True)
    path = folder / "pupil.yaml"
    path.write_text(yaml_text(plain(content)))
    return path


def _require_units(stage: str, window: Sequence[int], side: Mapping[str, Any], diameter_m: float) -> None:
    """Raise ConfigurationError where pixels are too large or too small for units as they are meant."""
    scale_mas, lit = side["pixel_scale_mas"], side.get("spectrum") or [{"wavelength_nm": math.nan}]
    nm = min(point["wavelength_nm"] for point in lit)
    in_pixel = 1 / resolution_px(nm * NM, diameter_m, scale_mas)
    if in_pixel > COARSEST or in_pixel * min(window) < NARROWEST:
        raise ConfigurationError(
            f"{stage}(): pixel_scale_mas = {scale_mas:g} is {in_pixel:.2g} λ/D at {nm:g} nm and "
            f"{diameter_m:g} m, the window {in_pixel * min(window):.2g} λ/D; check the units"
        )


def _flat(several: Any) -> Iterator[Any]:
    """One recording, or each of those in a list or tuple."""
    for one in several if isinstance(several, (list, tuple)) else [several]:
        yield from _flat(one) if isinstance(one, (list, tuple)) else [one]


def _require(stage: str, keys: Mapping[str, Any]) -> None:
    """Raise ConfigurationError where there is no word of what no default is safe for."""
    instead = {"wavelength_nm": ("spectrum", "filter_curve")}
    for key, meaning in NEEDED.items():
        if not {key, *instead.get(key, ())} & keys.keys():
            raise ConfigurationError(f"{stage}(): {key} is missing: {meaning}")


def _sidecar(stage: str, keys: Mapping[str, Any], index: int = 0, count: int = 1) -> dict[str, Any]:
    """The keys of the side-car of one of several recordings."""
    own = {key: _of_one(stage, key, value, index, count) for key, value in keys.items()}
    side = {key: value for key, value in own.items() if key in AcquisitionKeys.model_fields}
    detector = {key: value for key, value in own.items() if key in DetectorKeys.model_fields}
    wavelengths = own.get("wavelength_nm")
    if wavelengths is not None:
        weights = wavelengths.items() if isinstance(wavelengths, dict) else [(wavelengths, 1.0)]
        side["spectrum"] = [{"wavelength_nm": nm, "weight": weight} for nm, weight in weights]
    if isinstance(side.get("diversity"), dict) and "zernike" not in side["diversity"]:
        side["diversity"] = {"zernike": side["diversity"]}
    side |= {"detector": side.get("detector", {}) | detector} if detector else {}
    require_valid(side, AcquisitionKeys, Origins(Path(), {}, [((), f"{stage}()")]))
    return side


def _of_one(stage: str, key: str, value: Any, index: int, count: int) -> Any:
    """The value for one of several recordings: the same for all, or one from a list."""
    if not isinstance(value, list) or (key in OWN_LISTS and count == 1):
        return value
    if len(value) != count:
        more = "; a spectrum is {wavelength: weight}" if key == "wavelength_nm" else ""
        raise ConfigurationError(
            f"{stage}(): {key} has {len(value)} values for {plural(count, 'array')} of images{more}"
        )
    return value[index]


def _cube(images: Any, where: str) -> np.ndarray:
    """Images (frames, rows, columns) of a type that FITS has."""
    masked = isinstance(images, np.ma.MaskedArray)
    try:
        array = images.astype(float).filled(np.nan) if masked else np.asarray(images)
    except ValueError:
        raise InputDataError(f"{where}: frames of different shapes") from None
    if array.ndim not in (2, 3):
        raise InputDataError(f"{where}: axes {array.shape or 'none'}, expected (frames, y, x) or (y, x)")
    cube = require_cube(array if array.ndim == 3 else array[None], where)
    if not np.isfinite(cube).any():
        raise InputDataError(f"{where}: no pixel has a finite value")
    small = cube.dtype in (np.float16, np.int8, np.uint8)
    return cube.astype(np.float32 if small else np.float64) if small or cube.dtype.itemsize > 8 else cube


def plain(value: Any) -> Any:
    """Return `value` in the types of YAML: NumPy's numbers and arrays become Python's, tuples lists."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {plain(key): plain(one) for key, one in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
    return value
