"""Whether frames are taken as those that a calibration is for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from irlos_pipe.frames.recording import Acquisition
from irlos_pipe.readers.sidecar import AcquisitionKeys

PART = 1e-3  # of a wavelength, weight, pixel scale or gain; of less, side-cars are rounded
DIVERSITY_NM = 0.5

Spectrum = Sequence[tuple[float, float]]


def optical_differences(frames: Acquisition, calibrated: Acquisition) -> list[str]:
    """Return what makes images of some frames others than those of a calibration, an item for each key.

    Parameters
    ----------
    frames, calibrated : Acquisition
        How the ones and the others are taken.
    """
    found = [
        *_of_spectrum(frames.spectrum, calibrated.spectrum),
        *_of_number("pixel_scale_mas", frames.pixel_scale_mas, calibrated.pixel_scale_mas),
        *_of_diversity(frames.diversity, calibrated.diversity),
    ]
    if frames.lenslets != calibrated.lenslets:
        found.append(f"{frames.lenslets}x{frames.lenslets} lenslets, not {calibrated.lenslets}")
    return found


def exposure_differences(frames: Acquisition, calibrated: Acquisition) -> list[str]:
    """Return what makes the noise of some frames another than that of a calibration's, an item for each key.

    Parameters
    ----------
    frames, calibrated : Acquisition
        How the ones and the others are taken; what is not known of either does not differ.
    """
    pairs = [
        ("exposure_s", frames.exposure_s, calibrated.exposure_s),
        ("read_noise_e", frames.detector.read_noise_e, calibrated.detector.read_noise_e),
        (
            "excess_noise_factor",
            frames.detector.excess_noise_factor,
            calibrated.detector.excess_noise_factor,
        ),
    ]
    return [line for name, here, there in pairs for line in _of_number(name, here, there)]


def stated_differences(keys: AcquisitionKeys, calibrated: Acquisition) -> list[str]:
    """Return what a side-car states otherwise than it is calibrated, an item for each key.

    Parameters
    ----------
    keys : AcquisitionKeys
        Of the side-car; what it leaves out does not differ.
    calibrated : Acquisition
    """
    stated = keys.flat()
    found: list[str] = []
    if "spectrum" in stated:
        spectrum = [(one.wavelength_nm, one.weight) for one in stated["spectrum"]]
        found += _of_spectrum(spectrum, calibrated.spectrum)
    if "diversity" in stated:
        found += _of_diversity(stated["diversity"].zernike, calibrated.diversity)
    numbers = {"pixel_scale_mas": calibrated.pixel_scale_mas}
    if not stated.get("detector.coadds_averaged"):  # else it is that of a read
        numbers["detector.e_per_adu"] = calibrated.detector.e_per_adu
    return found + [
        line for key, there in numbers.items() for line in _of_number(key, stated.get(key), there)
    ]


def _of_number(name: str, here: float | None, there: float | None) -> Iterator[str]:
    if here is not None and there is not None and abs(here - there) > PART * abs(there):
        yield f"{name} {here:g}, not {there:g}"


def _of_spectrum(here: Spectrum, there: Spectrum) -> Iterator[str]:
    one, other = _normal(here), _normal(there)
    if one.shape != other.shape or not np.allclose(one, other, rtol=PART, atol=PART):
        yield f"spectrum {_text(one)}, not {_text(other)}"


def _normal(spectrum: Spectrum) -> np.ndarray:
    """Wavelengths in order, and weights of sum 1; without those of no weight."""
    lit = np.array(sorted(one for one in spectrum if one[1] > 0), float).reshape(-1, 2)
    return lit / [1.0, max(lit[:, 1].sum(), 1e-300)]


def _text(spectrum: np.ndarray) -> str:
    return (
        "+".join(f"{nm:.0f}" for nm in spectrum[:, 0])
        + " nm ("
        + "+".join(f"{weight:.2f}" for weight in spectrum[:, 1])
        + ")"
    )


def _of_diversity(here: dict[int, float], there: dict[int, float]) -> Iterator[str]:
    for noll in sorted({*here, *there}):
        one, other = here.get(noll, 0.0), there.get(noll, 0.0)
        if abs(one - other) > DIVERSITY_NM:
            yield f"diversity of Noll {noll} {one:g} nm, not {other:g}"
