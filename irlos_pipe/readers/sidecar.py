"""The side-car ``acquisition.yaml``: what the data themselves cannot say.

`AcquisitionKeys` declares every key once: its limits, its meaning, and what else may know its value.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError
from irlos_pipe.conventions.text import and_more
from irlos_pipe.files.validation import Origins, absolute, require_valid
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.instrument.instrument import Instrument, is_path, load_instrument
from irlos_pipe.readers.fitsfile import has_fits_name, stem

FOLDER_SIDECAR = "acquisition.yaml"
MAX_WAVELENGTH_RATIO = 3.0
Role = Literal["ncpa_calibration", "defocus_ramp", "derotator", "psf", "dark"]


@dataclass(frozen=True)
class Known:
    """What knows the value of a key where neither side-car nor recipe has it."""

    eso: str = ""  # keyword of an ESO header with the same meaning and unit, which is believed
    proposed: tuple[str, ...] = ()  # keywords of common use; their values are only proposed in a new side-car
    otherwise: Any = None  # value that does no harm where nothing is known
    mute: bool = False  # whether a value from elsewhere is not worth a warning
    form: str = ""  # what to write, of a key of which no value is safe to assume

    @property
    def keywords(self) -> tuple[str, ...]:
        return (self.eso, *self.proposed) if self.eso else self.proposed


class _Section(BaseModel):
    model_config = ConfigDict(
        defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True
    )

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_no_truth_values(cls, values: Any) -> Any:
        """Refuse ``true`` where a number is expected, which would count as 1."""
        if isinstance(values, dict):
            for key, value in values.items():
                field = cls.model_fields.get(str(key))
                if isinstance(value, bool) and field is not None and "bool" not in str(field.annotation):
                    raise ValueError(f"{key} is {str(value).lower()}, which is no number; give its value")
        return values


class SpectrumPoint(_Section):
    """One wavelength with its photon weight."""

    wavelength_nm: float = Field(ge=100, le=30000, description="wavelength in nm")
    weight: float = Field(1.0, ge=0, description="photons, any scale")


class DiversityKeys(_Section):
    """The aberration put in on purpose."""

    source: str = Field("lens", min_length=1, description="what introduces it, for example lens")
    zernike: dict[int, float] = Field(description="Noll index: nm RMS")

    @model_validator(mode="after")
    def _sensible(self) -> "DiversityKeys":
        for noll, nm in self.zernike.items():
            if not 2 <= noll <= 1000:
                raise ValueError(f"zernike: {noll} is no Noll index from 2 to 1000")
            if abs(nm) > 10000:
                raise ValueError(f"zernike: {nm} nm RMS for Noll {noll} is beyond 10000 nm")
        return self


def _key(meaning: str, known: Known = Known(), **limits: Any) -> Any:
    field = Field(None, description=meaning, **limits)
    field.metadata.append(known)
    return field


class DetectorKeys(_Section):
    """Detector constants."""

    e_per_adu: float | None = _key(
        "photo-electrons per ADU", Known(proposed=("EGAIN", "ESO DET OUT1 CONAD", "GAIN")), gt=0, le=1e5
    )
    read_noise_e: float | None = _key(
        "RMS per pixel and read in e-, rounding included",
        Known(proposed=("RDNOISE", "READNOIS", "ESO DET OUT1 RON")),
        ge=0,
        le=1e5,
    )
    excess_noise_factor: float | None = _key("photon variance over Poisson's", Known(mute=True), ge=1, le=10)
    saturation_adu: float | None = _key("raw level that counts as saturated", gt=0)
    coadds: int | None = _key(
        "reads in a frame", Known(proposed=("COADDS", "COADDONE", "CO_ADDS", "NCOADDS")), ge=1, le=10**6
    )
    coadds_averaged: bool | None = _key("mean of the reads, not their sum")
    read_s: float | None = _key("exposure of a read in seconds", Known(mute=True), gt=0, le=3600)
    dark_e_per_s: float | None = _key("dark current per pixel in e-/s", Known(mute=True), ge=0, le=1e8)


class AcquisitionKeys(_Section):
    """Every key of the side-car. All may be left out here; `acquisition.resolve` knows what is required."""

    role: Role | None = _key(
        "what the recording is for", Known(form="ncpa_calibration, defocus_ramp, derotator, psf or dark")
    )
    target: str | None = _key("name of the star", Known(proposed=("OBJECT", "TARGNAME"), otherwise=""))
    mag_j: float | None = _key("J magnitude", Known("ESO SEQ NGS MAG"), ge=-5, le=30)
    exposure_s: float | None = _key(
        "exposure of a frame in seconds", Known(proposed=("EXPTIME",)), gt=0, le=3600
    )
    frame_rate_hz: float | None = _key("recorded frames per second", gt=0, le=1e5)
    pixel_scale_mas: float | None = _key("mas per pixel", gt=0, le=10000)
    seeing_arcsec: float | None = _key(
        "seeing, on SPARTA's scale or another", Known("ESO TEL AMBI FWHM START", ("SEEING",)), gt=0, le=10
    )
    seeing_scale: str | None = _key("who measured it, for example mass_dimm", min_length=1)
    spectrum: list[SpectrumPoint] | None = _key(
        "wavelengths with weights",
        Known(form="[{wavelength_nm: 1600, weight: 1.0}], any number of points"),
        min_length=1,
        max_length=100,
    )
    diversity: DiversityKeys | None = _key(
        "aberration introduced on purpose",
        Known(form="{source: lens, zernike: {6: -170.0}}, Noll: nm RMS; zernike: {} without one"),
    )
    introduced_defocus_nm: float | list[float] | None = _key(
        "nm RMS, one or one per frame", Known(otherwise=0.0)
    )
    derotator_angle_deg: float | None = _key(
        "angle of the derotator", Known("ESO INS DROT START", otherwise=0.0), ge=-720, le=720
    )
    parallactic_angle_deg: float | None = _key(
        "parallactic angle", Known("ESO TEL PARANG START", ("PARANG",), mute=True), ge=-360, le=360
    )
    pupil_rotation_deg: float | None = _key(
        "of the pupil on the detector, anticlockwise from the profile's",
        Known(otherwise=0.0),
        ge=-720,
        le=720,
    )
    altitude_deg: float | None = _key(
        "altitude of the telescope", Known("ESO TEL ALT", ("EL",), mute=True), ge=0, le=90
    )
    airmass: float | None = _key(
        "1 / sin(altitude), instead of it", Known("ESO TEL AIRM START", ("AIRMASS",), mute=True), ge=1, le=40
    )
    zenith_angle_deg: float | None = _key(
        "direction of the zenith in the image, from +x towards +y", Known(mute=True), ge=-720, le=720
    )
    pressure_hpa: float | None = _key(
        "air pressure at the telescope", Known("ESO TEL AMBI PRES START", mute=True), gt=0, le=1100
    )
    temperature_c: float | None = _key(
        "its temperature", Known("ESO TEL AMBI TEMP", mute=True), ge=-90, le=60
    )
    humidity_percent: float | None = _key(
        "its relative humidity", Known("ESO TEL AMBI RHUM", mute=True), ge=0, le=100
    )
    dispersion_corrected: bool | None = _key("a corrector takes out the atmosphere's", Known(otherwise=False))
    sky_e_per_s: float | None = _key("light of the sky per pixel in e-/s", Known(otherwise=0.0), ge=0, le=1e8)
    filter: str | None = _key("name of the filter", Known(proposed=("FILTER",), otherwise=""), min_length=1)
    filter_curve: list[tuple[float, float]] | None = _key(
        "[wavelength in nm, transmission], …; instead of spectrum", min_length=3
    )
    star_temperature_k: float | None = _key(
        "of the star, with the curve", Known(mute=True), ge=1000, le=50000
    )
    j_minus_h: float | None = _key("colour of the star, instead of it", Known(mute=True), ge=-5, le=20)
    mode: str | None = _key("read-out mode of a MUSE raw file whose header lacks it", min_length=1)
    detector: DetectorKeys | None = _key("detector constants")

    @model_validator(mode="after")
    def _one_band(self) -> "AcquisitionKeys":
        """A wide band needs a wide field in memory; nobody images three octaves at once."""
        lit = [point.wavelength_nm for point in self.spectrum or () if point.weight > 0]
        if self.spectrum is not None and not lit:
            raise ValueError("spectrum: at least one weight must be positive")
        if lit and max(lit) > MAX_WAVELENGTH_RATIO * min(lit):
            raise ValueError(
                f"spectrum: from {min(lit):g} to {max(lit):g} nm; the longest wavelength may be "
                f"{MAX_WAVELENGTH_RATIO:g} times the shortest"
            )
        return self

    def updated(self, other: "AcquisitionKeys") -> "AcquisitionKeys":
        """Return these keys with those that `other` gives replaced."""
        own, new = (keys.model_dump(exclude_none=True) for keys in (self, other))
        detector = own.get("detector", {}) | new.get("detector", {})
        return AcquisitionKeys.model_validate(own | new | ({"detector": detector} if detector else {}))

    def flat(self) -> dict[str, Any]:
        """Return the keys that were given, those of the detector dotted (``detector.e_per_adu``)."""
        fields = type(self).model_fields  # in the order of the class: that of a set differs between processes
        given = {key: getattr(self, key) for key in fields if getattr(self, key) is not None}
        detector = given.pop("detector", None)
        inner = {} if detector is None else detector.model_dump(exclude_none=True)
        return given | {f"detector.{key}": value for key, value in inner.items()}


class SidecarKeys(AcquisitionKeys):
    """The keys of the file: a recipe that has some of them under ``ingest`` states its instrument itself."""

    instrument: str | None = _key(
        "instrument profile: a name, or the path of a YAML file, relative to the side-car", min_length=1
    )


KEYS: dict[str, FieldInfo] = {
    **{key: field for key, field in SidecarKeys.model_fields.items() if key != "detector"},
    **{f"detector.{key}": field for key, field in DetectorKeys.model_fields.items()},
}
KNOWN = {key: next(one for one in field.metadata if isinstance(one, Known)) for key, field in KEYS.items()}


def is_valid(key: str, value: Any) -> bool:
    """Return whether a `key`, dotted if it is of the detector, can have a `value`."""
    section, _, inner = key.rpartition(".")
    try:
        SidecarKeys.model_validate({section: {inner: value}} if section else {key: value})
    except ValidationError:
        return False
    return value is not None and value != ""


def own_sidecar(data_file: Path) -> Path:
    """Return where the side-car of a data file would be that is its alone: ``<stem>.yaml``."""
    return data_file.with_name(f"{stem(data_file)}.yaml")


def sidecar_path(data_file: Path) -> Path:
    """Return where the side-car of a data file is, or would be.

    ``<stem>.yaml`` next to the file if there is one, else ``acquisition.yaml`` in its folder.
    """
    own = own_sidecar(data_file)
    return own if own.is_file() else data_file.with_name(FOLDER_SIDECAR)


def stated_instruments(paths: Iterable[Path]) -> dict[str, Path]:
    """Return the instruments that side-cars of files or folders `paths` state, each with the first of them.

    A path of a profile is absolute. What is wrong with a side-car is said where it is read.
    """
    found: dict[str, Path] = {}
    for sidecar in dict.fromkeys(chain.from_iterable(map(_sidecars_of, paths))):
        with suppress(IrlosError, OSError):
            name = load_yaml(sidecar)[0].get("instrument")
            if isinstance(name, str) and name:
                found.setdefault(str(absolute(name, sidecar.parent)) if is_path(name) else name, sidecar)
    return found


def stated_instrument(stated: Mapping[str, Path]) -> tuple[str, Instrument, str]:
    """Return the one instrument that side-cars have `stated`: its name or path, itself, and who states it.

    Raises `InputDataError` where they state several, or one that cannot be used.
    """
    (name, sidecar), *others = stated.items()
    for other, at in others:
        raise InputDataError(
            f"{sidecar}: instrument = {name}, but {at} states {other}; reduce them apart, correct one, "
            "or give --set instrument=NAME"
        )
    try:
        return name, load_instrument(name), f"side-car {sidecar.name}"
    except ConfigurationError as error:
        raise InputDataError(f"{sidecar}: {error}") from None


def _sidecars_of(path: Path) -> Iterator[Path]:
    """Side-cars of a file, or in a folder and below, each folder once; no data file is opened."""
    if not path.is_dir():
        yield from filter(Path.is_file, [sidecar_path(path)])
    seen: set[str] = set()
    for folder, below, files in os.walk(path, followlinks=True):
        seen.add(os.path.realpath(folder))
        below[:] = [one for one in below if os.path.realpath(Path(folder, one)) not in seen]
        own = {f"{stem(Path(one))}.yaml" for one in files if has_fits_name(Path(one))} | {FOLDER_SIDECAR}
        yield from (Path(folder, one) for one in sorted(own.intersection(files)))


def read_sidecar(path: Path) -> SidecarKeys:
    """Read and check a side-car; one that does not exist has no keys.

    Raises `InputDataError` with one line ``file:line: problem``, and how many more problems there are.
    """
    try:
        return _read(path)
    except ConfigurationError as error:
        lines = str(error).splitlines()
        # a key that is misspelt is missing as well; the suggestion says more
        best = min(lines, key=lambda line: "did you mean" not in line)
        raise InputDataError(best + and_more(lines)) from None


def sidecar_problems(path: Path) -> list[str]:
    """Return a line ``file:line: problem`` for everything that is wrong with a side-car."""
    try:
        _read(path)
    except (ConfigurationError, InputDataError) as error:
        return str(error).splitlines()
    return []


def _read(path: Path) -> SidecarKeys:
    if not path.exists():
        return SidecarKeys()
    data, lines = load_yaml(path, InputDataError)
    return require_valid(data, SidecarKeys, Origins(path, lines))
