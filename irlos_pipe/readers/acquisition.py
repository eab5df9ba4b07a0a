"""A recording as it stands in its files, and how it was taken: recipe over side-car over header over profile.

What the keywords of a header say does not depend on the layout.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from astropy.io import fits

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.laws import SPARTA
from irlos_pipe.conventions.reads import adds_up, whole_reads
from irlos_pipe.conventions.text import printable, suggestion
from irlos_pipe.frames.recording import (
    HEADER,
    MODE,
    PROFILE,
    RECIPE,
    SIDECAR,
    Acquisition,
    Detector,
    RawFrames,
)
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.fitsfile import header_number
from irlos_pipe.readers.sidecar import (
    KNOWN,
    AcquisitionKeys,
    SpectrumPoint,
    is_valid,
    read_sidecar,
    sidecar_path,
)

MONITOR = "mass_dimm"  # seeing monitor of ESO's headers
# Cards that products inherit.
PLAIN = frozenset(
    (
        "ORIGIN", "TELESCOP", "INSTRUME", "OBJECT", "RA", "DEC", "EQUINOX", "RADESYS", "DATE-OBS", "MJD-OBS",
        "EXPTIME", "UTC", "LST", "PI-COI", "OBSERVER", "ARCFILE", "ORIGFILE",
    )
)  # fmt: skip
# Who observed what with which template, and where telescope and derotator stood.
GROUPS = re.compile(
    r"ESO (OBS (ID|NAME|PROG ID|TARG NAME)|TPL (ID|NAME|START)|DPR (CATG|TYPE|TECH)|INS (MODE|DROT [A-Z]+)|"
    r"TEL (ALT|AZ|AIRM [A-Z]+|PARANG [A-Z]+|AMBI [A-Z0-9 ]+)|SEQ NGS MAG|AOS MAIN MODES IRLOS)"
)
MAX_CARDS = 100  # that a product inherits: a header may repeat a card many times


@dataclass(frozen=True, kw_only=True)
class RawRecording(RawFrames):
    name: str  # of the recording, from its file
    path: Path  # the file with the frames
    layout: str  # ``sparta_recorder``, ``muse_raw``, ``fits_cube`` or ``aot``
    # time of each frame, (frames,), NaN where it is not known [s since 1970]; None when no frame has one
    unix_s: np.ndarray | None = None
    header: Mapping[str, Any] = field(default_factory=dict)  # dotted side-car keys that the file itself knows
    mode: str = ""  # of the read-out, empty where the layout has none
    of_mode: Mapping[str, Any] = field(default_factory=dict)  # side-car keys that the profile has of the mode
    start_unix_s: float = float("nan")  # begin of the recording, NaN if not known [s since 1970]
    notes: tuple[str, ...] = ()  # remarks for the log
    warnings: tuple[str, ...] = ()  # remarks that people should see
    cards: Mapping[str, Any] = field(default_factory=dict)  # what products inherit of the primary header


def header_keys(header: fits.Header) -> dict[str, Any]:
    """Return side-car keys with the finite numbers that an ESO `header` has, and whose seeing it is."""
    numbers = {key: header_number(header, known.eso) for key, known in KNOWN.items() if known.eso}
    found: dict[str, Any] = {key: value for key, value in numbers.items() if value is not None}
    return found | ({"seeing_scale": MONITOR} if "seeing_arcsec" in found else {})


def plain_header_keys(
    path: Path, header: fits.Header, instrument: Instrument
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what `header_keys` finds in the `header` of the file `path` of any instrument, and remarks.

    The seeing is left out where the profile of the `instrument` has no scale for its monitor: no recording
    should fail for what nobody declared.
    """
    found = header_keys(header)
    if "seeing_arcsec" not in found or MONITOR in instrument.seeing_scales:
        return found, ()
    note = (
        f"{path}: the seeing of the header, {found['seeing_arcsec']:g} arcsec, is not used: "
        f"the profile of {instrument.name} has no seeing scale '{MONITOR}'"
    )
    unused = ("seeing_arcsec", "seeing_scale")
    return {key: value for key, value in found.items() if key not in unused}, (note,)


def inherited_cards(header: fits.Header) -> dict[str, str | bool | int | float]:
    """Return keyword and value of what products inherit of the `header` of a recording."""
    found: dict[str, str | bool | int | float] = {}
    for card in header.cards:
        keyword, value = card.keyword, card.value
        if len(found) == MAX_CARDS:
            break
        if (keyword in PLAIN or GROUPS.fullmatch(keyword)) and _can_be_handed_on(value):
            found.setdefault(keyword, printable(value) if isinstance(value, str) else value)
    return found


def _can_be_handed_on(value: object) -> bool:
    if isinstance(value, str):
        return bool(value.strip())
    return isinstance(value, (bool, int)) or (isinstance(value, float) and math.isfinite(value))


C2_NM_K = 1.438776877e7  # second radiation constant
J_NM, H_NM, VEGA_K = 1235.0, 1662.0, 9600.0  # 2MASS bands, and the black body that has no colour between them
OPEN_END = 0.05  # a filter curve that ends above this part of its largest transmission is cut off
DARK = 0.01  # part of the largest transmission below which a filter counts as opaque
POINTS_PER_BAND = 3
COOLEST_K, HOTTEST_K = 1000.0, 50_000.0
Point = tuple[float, float]

REQUIRED = tuple(key for key, known in KNOWN.items() if known.form)
REQUIRED_FOR = {"dark": ("role",), "defocus_ramp": (*REQUIRED, "introduced_defocus_nm")}
HARMLESS = {key: known.otherwise for key, known in KNOWN.items() if known.otherwise is not None}
ALTITUDE = ("altitude_deg", "airmass")  # two keys for the same quantity
AIRMASS_TOLERANCE = 0.03  # an exposure begins and ends at another one; sec z is within 1 % above 15°
COADDS, READ_S, READ_NOISE = "detector.coadds", "detector.read_s", "detector.read_noise_e"


def photons(wavelengths_nm: np.ndarray, temperature_k: float) -> np.ndarray:
    """Return photons per wavelength of a black body of `temperature_k` at `wavelengths_nm`, on any scale."""
    return wavelengths_nm**-4.0 / np.expm1(C2_NM_K / (wavelengths_nm * temperature_k))


def colour_of(temperature_k: float) -> float:
    """Return J − H [mag] of a black body of `temperature_k` against Vega's."""
    star, vega = (photons(np.array([J_NM, H_NM]), t) for t in (temperature_k, VEGA_K))
    return float(-2.5 * np.log10(star[0] / star[1] * vega[1] / vega[0]))


def temperature_of(j_minus_h: float, where: str) -> float:
    """Return the temperature of the black body that has a colour `j_minus_h` [K]; `where` begins an error.

    Raises `InputDataError` for a colour that no star from 1000 to 50000 K has.
    """
    bluest, reddest = colour_of(HOTTEST_K), colour_of(COOLEST_K)
    if not bluest < j_minus_h < reddest:
        raise InputDataError(
            f"{where} j_minus_h = {j_minus_h:g} is the colour of no star; it should lie between {bluest:.2f} "
            f"and {reddest:.2f}"
        )
    return float(scipy.optimize.brentq(lambda t: colour_of(t) - j_minus_h, COOLEST_K, HOTTEST_K))


def spectrum_of(curve: Sequence[Point], temperature_k: float, where: str) -> list[Point]:
    """Return wavelengths and photon weights, three in every band of the filter.

    Each third of a band's photons stands at its own mean wavelength. The `curve` has wavelengths [nm] and
    transmissions, `temperature_k` is that of the star, `where` begins the message of an error.

    Raises `InputDataError` for a curve that is no function of wavelength, or ends where the filter still
    transmits.
    """
    wavelengths_nm, transmission = _checked(curve, where)
    fine = np.linspace(wavelengths_nm[0], wavelengths_nm[-1], 4000)
    passed = np.interp(fine, wavelengths_nm, transmission)
    weight = np.where(passed > DARK * transmission.max(), passed * photons(fine, temperature_k), 0.0)
    lit = np.flatnonzero(weight)
    bands = np.split(lit, np.flatnonzero(np.diff(lit) > 1) + 1)
    points = [point for band in bands for point in _thirds(fine[band], weight[band])]
    total = sum(share for _, share in points)
    return [(nm, share / total) for nm, share in points]


def _checked(curve: Sequence[Point], where: str) -> tuple[np.ndarray, np.ndarray]:
    wavelengths_nm, transmission = np.array(curve, float).T
    if np.any(np.diff(wavelengths_nm) <= 0) or np.any(transmission < 0) or not transmission.any():
        raise InputDataError(
            f"{where} filter_curve: wavelengths should rise, and transmissions not be negative or all zero"
        )
    for end, which in ((0, "shortest"), (-1, "longest")):
        if transmission[end] > OPEN_END * transmission.max():
            raise InputDataError(
                f"{where} filter_curve does not cover the band: at its {which} wavelength, "
                f"{wavelengths_nm[end]:g} nm, the filter still transmits {transmission[end]:g}; "
                "continue it to zero"
            )
    return wavelengths_nm, transmission


def _thirds(wavelengths_nm: np.ndarray, weight: np.ndarray) -> list[Point]:
    """Mean wavelength and photons of each part of a band that holds the same number of them."""
    middle = (np.cumsum(weight) - weight / 2) / weight.sum()
    parts = np.minimum((middle * POINTS_PER_BAND).astype(int), POINTS_PER_BAND - 1)
    return [
        (
            float(np.average(wavelengths_nm[parts == k], weights=weight[parts == k])),
            float(weight[parts == k].sum()),
        )
        for k in np.unique(parts)
    ]


@dataclass(frozen=True, eq=False)
class Resolved:
    """A recording as read, how it was taken, and the recipe input that it belongs to."""

    raw: RawRecording
    acquisition: Acquisition
    introduced_defocus_nm: np.ndarray  # (frames,) [nm RMS]
    warnings: tuple[str, ...]  # what had to be taken from the header or the instrument profile
    input: str = ""


@dataclass(frozen=True)
class _KnownKeys:
    """The value of every key and where it came from; `where` begins messages."""

    where: str
    values: dict[str, Any] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)

    def add(self, source: str, layer: Mapping[str, Any]) -> None:
        """Take from a `source` the keys that no earlier one has."""
        for key, value in layer.items():
            if key not in self.values:
                self.values[key], self.sources[key] = value, source

    def stated(self, key: str) -> bool:
        """Whether anybody but the profile states it."""
        return self.sources.get(key, PROFILE) != PROFILE


def resolve(raw: RawRecording, recipe: AcquisitionKeys, instrument: Instrument, input: str = "") -> Resolved:
    """Find the value of every key of a recording of an `input`, and remember where it came from.

    The `recipe` wins over everything; the profile of the `instrument` gives the values that are stated
    nowhere else, where that is safe.

    Raises `InputDataError` where a key without a safe default is missing, or there is not one defocus per
    frame.
    """
    path = sidecar_path(raw.path)
    side = read_sidecar(path)
    layers: dict[str, Mapping[str, Any]] = {RECIPE: recipe.flat(), SIDECAR: side.flat()}
    # Altitude and airmass that are declared are of another moment than those of the header.
    dropped = ALTITUDE if any(key in layers[one] for one in (SIDECAR, RECIPE) for key in ALTITUDE) else ()
    layers |= {
        # ESO writes -1 where nothing was measured.
        HEADER: {key: one for key, one in raw.header.items() if is_valid(key, one) and key not in dropped},
        MODE: raw.of_mode,
        PROFILE: instrument.defaults | HARMLESS,
    }
    known = _KnownKeys(f"{path}:" if path.exists() else f"{raw.path}: no side-car {path.name};")
    for source, layer in layers.items():
        known.add(source, layer)
    values, sources = known.values, known.sources
    if "spectrum" not in values and "filter_curve" in values:
        known.add(sources["filter_curve"], {"spectrum": _spectrum(known)})
    _require(known)
    values["pupil_rotation_deg"] = _pupil_rotation(known, instrument)
    for key, degrees in _of_the_sky(known, instrument).items():
        values[key], sources[key] = degrees, sources.get(key, PROFILE)
    if known.stated(COADDS) and known.stated(READ_S) and not known.stated("exposure_s"):
        # an archive may have lost it; it goes before the profile's
        known.sources["exposure_s"] = known.sources[READ_S]
        known.values["exposure_s"] = known.values[COADDS] * known.values[READ_S]
    reads = _reads(known)
    defocus = _per_frame(known, raw)
    without_magnitude = any("mag_j" in one.model_fields_set and one.mag_j is None for one in (recipe, side))
    if without_magnitude and sources.get("mag_j") not in (RECIPE, SIDECAR):
        values["mag_j"], sources["mag_j"] = None, SIDECAR
    warnings = _warnings(raw, known, instrument.name)
    monitor = SPARTA  # or as the recipe says, else as the source of the seeing says
    if known.stated("seeing_arcsec"):
        of_seeing = layers[sources["seeing_arcsec"]].get("seeing_scale", SPARTA)
        monitor = layers[RECIPE].get("seeing_scale") or of_seeing
    if monitor != SPARTA:
        warnings = (*warnings, _put_on_sparta_scale(raw, values, monitor, instrument))
    return Resolved(raw, _acquisition(raw, known, reads), defocus, warnings, input)


def _require(known: _KnownKeys) -> None:
    needed = REQUIRED_FOR.get(str(known.values.get("role")), REQUIRED)
    missing = [key for key in needed if not known.stated(key)]
    if missing:
        keys = "key" if len(missing) == 1 else "keys"
        raise InputDataError(
            f"{known.where} {keys} {', '.join(map(repr, missing))} missing, and no default is safe; "
            "add to the side-car, or to the recipe under ingest.acquisition"
        )


def _spectrum(known: _KnownKeys) -> list[SpectrumPoint]:
    """What the curve of the filter passes of the star."""
    values, where = known.values, known.where
    kelvin = values.get("star_temperature_k")
    if kelvin is None and "j_minus_h" in values:
        kelvin = temperature_of(values["j_minus_h"], where)
    if kelvin is None:
        raise InputDataError(f"{where} filter_curve needs the star: give star_temperature_k or j_minus_h")
    points = spectrum_of(values["filter_curve"], kelvin, where)
    return [SpectrumPoint(wavelength_nm=nm, weight=weight) for nm, weight in points]


def _pupil_rotation(known: _KnownKeys, instrument: Instrument) -> float:
    """As stated; else by the profile's rule, where it has one, from the angles of the recording [deg]."""
    rule = instrument.profile.pupil.turns if instrument.profile.pupil else None
    if known.stated("pupil_rotation_deg") or rule is None or known.values["role"] == "dark":
        return known.values["pupil_rotation_deg"]
    missing = [key for key in rule.factors if not known.stated(key)]
    if missing:
        angles = ", ".join(map(repr, missing))
        raise InputDataError(
            f"{known.where} the pupil of {instrument.name} turns with {angles}, which is not known; give it, "
            "or pupil_rotation_deg"
        )
    return rule.rotation_deg(known.values)


def _of_the_sky(known: _KnownKeys, instrument: Instrument) -> dict[str, float]:
    """Altitude and direction of the zenith, as far as they are known [deg].

    The altitude as stated, or from the airmass; the direction as stated, or by the profile's rule.
    """
    values = known.values
    altitude = altitude_deg(values.get("altitude_deg"), values.get("airmass"), known.where)
    found = {} if altitude is None else {"altitude_deg": altitude}
    rule, angles = instrument.profile.zenith, {**values, **found}
    if "zenith_angle_deg" not in values and rule is not None and rule.factors.keys() <= angles.keys():
        found["zenith_angle_deg"] = rule.rotation_deg(angles)
    return found


def altitude_deg(altitude: float | None, airmass: float | None, where: str) -> float | None:
    """Return the `altitude`, from the `airmass` where it is not stated [deg]; `where` begins a message.

    Raises `InputDataError` if the two contradict each other.
    """
    if airmass is None:
        return altitude
    if altitude is None:
        return math.degrees(math.asin(1 / airmass))
    seen = 1 / max(math.sin(math.radians(altitude)), 1e-3)
    if abs(airmass / seen - 1) > AIRMASS_TOLERANCE:
        raise InputDataError(
            f"{where} altitude_deg = {altitude:g} means an airmass of {seen:.3g}, but airmass = {airmass:g}; "
            "correct one of them"
        )
    return altitude


def _reads(known: _KnownKeys) -> int:
    """How many reads make up a frame: as declared; else as many declared reads as fill the exposure.

    The profile's read noise is that of one read: with it and no word of reads, a frame has as many of the
    profile's reads as its exposure takes.
    """
    values = known.values
    exposure_s, read_s = values.get("exposure_s"), values.get(READ_S)
    if known.stated(READ_S) and exposure_s is not None:
        return _filling(exposure_s, values[READ_S], values.get(COADDS), known.where)
    if known.stated(COADDS):
        return values[COADDS]
    if not known.stated(READ_NOISE) and read_s is not None and exposure_s is not None:
        return max(1, round(exposure_s / read_s))
    return 1


def _filling(exposure_s: float, read_s: float, coadds: int | None, where: str) -> int:
    if coadds is None:
        try:
            return whole_reads(exposure_s, read_s)
        except ConfigurationError as problem:
            raise InputDataError(f"{where} {problem}") from None
    if not adds_up(exposure_s, read_s, coadds):
        raise InputDataError(
            f"{where} detector.coadds = {coadds} reads of read_s = {read_s:g} s do not add up to "
            f"exposure_s = {exposure_s:g}; correct one of them"
        )
    return coadds


def _per_frame(known: _KnownKeys, raw: RawRecording) -> np.ndarray:
    source = known.sources["introduced_defocus_nm"]
    values = np.atleast_1d(np.asarray(known.values["introduced_defocus_nm"], dtype=np.float64))
    if values.size not in (1, raw.frames):
        where = sidecar_path(raw.path) if source == SIDECAR else f"{source}: {raw.path}"
        raise InputDataError(
            f"{where}: introduced_defocus_nm has {values.size} values for {raw.frames} frames; "
            "give one, or one per frame"
        )
    return np.broadcast_to(values, (raw.frames,)).copy()


def _warnings(raw: RawRecording, known: _KnownKeys, profile: str) -> tuple[str, ...]:
    """One line per source from which values had to be taken, and per value that cannot be used."""
    lines = []
    loud = [
        key
        for key, value in sorted(known.values.items())
        if isinstance(value, float) and not (KNOWN[key].mute or key in HARMLESS)
    ]
    for source, words in {HEADER: HEADER, MODE: MODE, PROFILE: f"{PROFILE} {profile}"}.items():
        taken = [f"{key} = {known.values[key]:.6g}" for key in loud if known.sources[key] == source]
        if taken:
            lines.append(f"{raw.name}: taken from the {words}: {', '.join(taken)}")
    for key, value in raw.header.items():
        if key in HARMLESS and not known.stated(key) and not is_valid(key, value):
            used = f"{known.values[key]:g} is taken; give {key} in the side-car"
            lines.append(f"{raw.name}: {key} = {value:g} of the header is out of range, and {used}")
    if "mag_j" not in known.values and known.values["role"] != "dark":
        lines.append(f"{raw.name}: mag_j is not known; magnitudes can only come from the measured flux")
    return tuple(lines)


def _put_on_sparta_scale(
    raw: RawRecording, values: dict[str, Any], monitor: str, instrument: Instrument
) -> str:
    """Translate the seeing among the `values`; returns a line that says so."""
    scales = instrument.seeing_scales
    if monitor not in scales:
        raise InputDataError(
            f"{raw.path}: seeing_scale = '{monitor}' is not known to the instrument profile"
            f"{suggestion(monitor, scales)}"
        )
    given = values["seeing_arcsec"]
    seeing = scales[monitor].to_sparta(given)
    if seeing <= 0:
        raise InputDataError(
            f"{raw.path}: seeing_arcsec = {given:g} by {monitor} would be {seeing:.3g} by SPARTA; "
            "correct it, or the scale in the instrument profile"
        )
    values["seeing_arcsec"] = seeing
    return f"{raw.name}: seeing of {given:.2f} arcsec by {monitor} taken as {seeing:.2f} arcsec by SPARTA"


def _acquisition(raw: RawRecording, known: _KnownKeys, reads: int) -> Acquisition:
    values = known.values
    diversity = values.get("diversity")
    names = {one.name for one in fields(Acquisition)}
    changed = {
        "detector": _detector(known, reads),
        "spectrum": tuple((point.wavelength_nm, point.weight) for point in values.get("spectrum", ())),
        "diversity": dict(diversity.zernike) if diversity else {},
        "diversity_source": diversity.source if diversity else "",
        "mode": raw.mode,
        "lenslets": raw.lenslets,
        "sources": known.sources,
    }
    return Acquisition(**{key: value for key, value in values.items() if key in names} | changed)


def _detector(known: _KnownKeys, reads: int) -> Detector:
    """Constants of a frame; the keys are those of one read, of which a frame is the sum or mean."""
    values = known.values
    coadds = values.get(COADDS, reads if known.stated(READ_S) else 1)
    background_e_per_s = values["sky_e_per_s"] + values.get("detector.dark_e_per_s", 0.0)
    return Detector(
        **of_a_frame(values, coadds),
        read_noise_e=values[READ_NOISE] * reads**0.5,
        excess_noise_factor=values.get("detector.excess_noise_factor", 1.0),
        reads=reads,
        background_e=background_e_per_s * (values.get("exposure_s") or 0.0),
    )


def of_a_frame(values: Mapping[str, Any], coadds: int) -> dict[str, Any]:
    """Return gain and saturation of a frame, as far as `values` have those of its `coadds` reads."""
    averaged = values.get("detector.coadds_averaged", False)
    factors = {"e_per_adu": coadds if averaged else 1, "saturation_adu": 1 if averaged else coadds}
    of_read = {key: values.get(f"detector.{key}") for key in factors}
    return {key: value * factors[key] for key, value in of_read.items() if value is not None}
