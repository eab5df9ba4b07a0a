"""What was told of a recording against what its frames show.

A contradiction beyond doubt fails the quality check; a doubtful one is worth a warning that says what hangs
on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import NM, cutoff_per_px
from irlos_pipe.frames.blocks import frame_flux
from irlos_pipe.frames.cutoff import cutoff_ratio
from irlos_pipe.frames.measured_noise import SIGNIFICANT, MeasuredNoise
from irlos_pipe.frames.recording import PROFILE, Recording

Range = tuple[float, float]
ANY = (-math.inf, math.inf)
# The zero point is that of the whole sensor band: a filter, mirrors and detector pass less, never more; the
# colour of the star may make up for 1.2 mag.
FLUX_DOUBTFUL, FLUX_IMPOSSIBLE = (3e-3, 3.0), (1e-5, 30.0)
OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE = (0.0, 1.05), (0.0, 2.0)
CADENCE_DOUBTFUL = (0.9, 1.1)
NOISE_IMPOSSIBLE = (0.25, 4.0)
CUTOFF_DOUBTFUL, CUTOFF_IMPOSSIBLE = (0.7, 1.12), (0.0, 1.25)
SCALE_PLAUSIBLE_MAS = (1.0, 100.0)
SMALLEST_NM = 5.0  # of a diversity or a ramp; anything smaller is likely to be in micrometres
HIGHEST_NOLL = 37  # of a diversity: a lens or a deformable mirror of low order


@dataclass(frozen=True)
class Told:
    """One thing told, as a number that the frames or plain sense confine.

    Attributes
    ----------
    value : float
    doubtful, impossible : (float, float)
        Ranges outside which it is worth a warning, and is wrong.
    text : str
        What the value is, and what hangs on it.
    """

    name: str
    value: float
    doubtful: Range
    impossible: Range
    text: str

    @property
    def wrong(self) -> bool:
        """Whether it is beyond doubt."""
        return not self.impossible[0] <= self.value <= self.impossible[1]

    @property
    def warned(self) -> bool:
        """Whether it is worth a warning."""
        return self.wrong or not self.doubtful[0] <= self.value <= self.doubtful[1]


def told_of(recording: Recording, noise: MeasuredNoise, facility: Facility, step_s: float) -> list[Told]:
    """Return what can be judged of what was told of a recording.

    Parameters
    ----------
    recording : Recording
    noise : MeasuredNoise
        Of its frames.
    facility : Facility
    step_s : float
        Time from frame to frame by the clock of the recorder; NaN where it is not known.
    """
    parts = (
        _flux(recording, facility),
        _times(recording, step_s),
        _noise(recording, noise),
        _cutoff(recording, facility),
        _keys(recording),
    )
    return [one for part in parts for one in part if math.isfinite(one.value)]


def _known(recording: Recording, key: str) -> float:
    """A number that somebody or the file itself told; NaN where it is only the profile's."""
    acquisition = recording.acquisition
    value = getattr(acquisition, key)
    told = acquisition.sources.get(key, PROFILE) != PROFILE
    return float(value) if told and value is not None else math.nan


def _flux(recording: Recording, facility: Facility) -> Iterator[Told]:
    mag_j, exposure_s = _known(recording, "mag_j"), _known(recording, "exposure_s")
    expected = facility.photons_per_s_m15 * 10 ** (0.4 * (15 - mag_j)) * exposure_s
    seen = (
        float(np.median(frame_flux(recording.images_e)[recording.used])) if recording.used.any() else math.nan
    )
    text = (
        f"{seen / expected:.2g} times the photons of J = {mag_j:g} in {exposure_s:g} s arrive: gain, "
        "magnitude or exposure; errors and limiting magnitudes hang on them"
    )
    yield Told("flux", seen / expected, FLUX_DOUBTFUL, FLUX_IMPOSSIBLE, text)


def _times(recording: Recording, step_s: float) -> Iterator[Told]:
    exposure_s, rate_hz = _known(recording, "exposure_s"), _known(recording, "frame_rate_hz")
    text = "times the time between frames is exposed: exposure_s or frame_rate_hz; magnitudes hang on it"
    overlap = exposure_s * rate_hz
    yield Told("exposure", overlap, OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE, f"{overlap:.3g} {text}")
    by_clock = exposure_s / step_s
    yield Told(
        "exposure by the clock", by_clock, OVERLAP_DOUBTFUL, OVERLAP_IMPOSSIBLE, f"{by_clock:.3g} {text}"
    )
    cadence = rate_hz * step_s
    told = f"the clock of the recorder has {1 / step_s:.4g} frames per second"
    yield Told("cadence", cadence, CADENCE_DOUBTFUL, ANY, f"{told}, told are {rate_hz:.4g}: times hang on it")


def _noise(recording: Recording, noise: MeasuredNoise) -> Iterator[Told]:
    """Photon transfer; a difference within its error is none."""
    used = recording.acquisition.detector.excess_noise_factor
    apart = abs(noise.excess_noise_factor - used) > SIGNIFICANT * noise.excess_noise_error
    ratio = noise.excess_noise_factor / used if apart else 1.0
    text = f"photon noise is {ratio:.2g} times what e_per_adu and excess_noise_factor say; errors hang on it"
    yield Told("photon noise", ratio, ANY, NOISE_IMPOSSIBLE, text)


def _cutoff(recording: Recording, facility: Facility) -> Iterator[Told]:
    acquisition = recording.acquisition
    if acquisition.lenslets > 1:
        return
    shortest_m = min(wavelength for wavelength, weight in acquisition.spectrum if weight > 0) * NM
    expected = cutoff_per_px(shortest_m, facility.pupil.diameter_m, acquisition.pixel_scale_mas)
    ratio = cutoff_ratio(recording.mean_e, recording.good, expected)
    text = f"detail ends at {ratio:.2f} times D/λ: pixel scale, wavelength or focus; all modes hang on them"
    yield Told("cut-off", ratio, CUTOFF_DOUBTFUL, CUTOFF_IMPOSSIBLE, text)


def _keys(recording: Recording) -> Iterator[Told]:
    """Values that no instrument of this kind has."""
    acquisition = recording.acquisition
    scale = acquisition.pixel_scale_mas
    yield Told("pixel scale", scale, SCALE_PLAUSIBLE_MAS, ANY, f"pixel_scale_mas = {scale:g}: unit?")
    for noll, nm in acquisition.diversity.items():
        size, noll_text = abs(nm) or math.inf, f"diversity Noll {noll}"
        text = f"{noll_text} of {nm:g} nm: unit? The sign of the even modes hangs on it"
        yield Told(noll_text, min(size, 1e9), (SMALLEST_NM, math.inf), ANY, text)
        yield Told(f"{noll_text}, index", float(noll), (2, HIGHEST_NOLL), ANY, f"{noll_text}: unusual mode")
    if acquisition.role == "defocus_ramp":
        largest = float(np.abs(recording.introduced_defocus_nm).max(initial=0.0))
        text = f"introduced defocus (Noll {DEFOCUS}) of {largest:g} nm at most: unit? The slope hangs on it"
        yield Told("introduced defocus", largest or math.nan, (SMALLEST_NM, math.inf), ANY, text)
