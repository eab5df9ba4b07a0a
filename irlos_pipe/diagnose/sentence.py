"""The verdict in the words of an engineer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from irlos_pipe.diagnose.verdict import NONE, UNKNOWN, Diagnosis, Step
from irlos_pipe.effects import LowWindEffect

PHRASES = {
    "tip_tilt_jitter": "image motion of {sigma_mas:.1f} mas RMS per axis",
    "vibration": "a vibration of {sigma_mas:.1f} mas RMS along {angle_deg:.0f}°",
    "atmospheric_dispersion": "a chromatic elongation of {mas_per_um:.0f} mas/µm along {angle_deg:.0f}°",
    "plate_scale": "pixels larger by {fraction:.2%}",
    "diversity_error": "{nm:.0f} nm more diversity",
    "phase_bump": "a bump of {nm:.0f} nm at ({x_m:.1f}, {y_m:.1f}) m in the pupil, {width_m:.1f} m wide",
    "companion": "a second source of {flux_ratio:.2%} at {sep_mas:.0f} mas, PA {pa_deg:.0f}°",
    "interpixel_crosstalk": "charge shared between pixels, {fraction:.2%}",
    "detector_nonlinearity": "a loss of {fraction_at_peak:.1%} at the brightest pixel",
    "background_gradient": "a background slope of {e_per_pixel:.2g} e⁻/px towards {angle_deg:.0f}°",
    "pupil_misregistration": "a stop {dx_m:.3f}, {dy_m:.3f} m off, vanes turned by {rotation_deg:.1f}°",
    "spectrum": "a spectrum about {wavelength_nm:.1f} nm, {width:.2f} times as wide",
    "bad_pixels": "bad pixels at {pixels}",
}
TABLES = {
    "high_order_ncpa": "{size:.0f} nm RMS of modes beyond those of the model",
    "ncpa_drift": "a drift of the wavefront of {size:.0f} nm RMS from the first frame to the last",
    "amplitude_aberration": "a pupil whose amplitude is uneven by {size:.1%} RMS",
}


def sentence(diagnosis: Diagnosis) -> str:
    """One or two sentences."""
    return f"{_found(diagnosis)}{_advised(diagnosis)}"


def _found(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == NONE:
        return f"Nothing significant is missing in the model{_limit(diagnosis)}."
    if diagnosis.verdict == UNKNOWN:
        nearest = diagnosis.nearest
        near = "" if nearest is None else f"; the nearest is {phrase(nearest)}"
        return f"Something is missing that nothing in the catalogue explains: {diagnosis.why_unknown}{near}."
    wanted = " and ".join(phrase(step) for step in diagnosis.steps)
    return f"The images want {wanted}{_others(diagnosis.steps)}; {_rest(diagnosis)}."


def _rest(diagnosis: Diagnosis) -> str:
    """What is missing besides the names."""
    if diagnosis.unexplained:
        return "besides, the pixels hold structure finer than the telescope can make, as of a wrong flat"
    return f"nothing else is missing{_limit(diagnosis)}"


def phrase(step: Step) -> str:
    """A name with its size."""
    if step.name == "seeing_halo" and "wfe_nm" in step.public:
        return f"an AO residual of {step.public['wfe_nm']:.0f} nm RMS"
    if step.name in PHRASES:
        return PHRASES[step.name].format(**step.public)
    if step.name in TABLES:
        return TABLES[step.name].format(size=_total(*step.public.values()))
    if step.name == LowWindEffect.name:
        return _petals(**step.public)
    numbers = ", ".join(f"{key} {value:.3g}" for key, value in step.public.items())
    return f"{step.name} with {numbers}"


def _total(table: Mapping[int, float]) -> float:
    """RMS of all Zernike modes together."""
    return float(np.linalg.norm(list(table.values())))


def _petals(piston_nm: Sequence[float], tip_nm: Sequence[float], tilt_nm: Sequence[float]) -> str:
    """How much petals differ from each other; what they have in common is no low-wind effect."""
    pistons_nm, slopes_nm = np.std(piston_nm), np.hypot(np.std(tip_nm), np.std(tilt_nm))
    return f"petals that differ by {pistons_nm:.0f} nm RMS in piston and {slopes_nm:.0f} nm in tip and tilt"


def _advised(diagnosis: Diagnosis) -> str:
    """Which further recording would show what this one hides."""
    by_recording: dict[str, list[str]] = {}
    for name, advice in diagnosis.advice.items():
        by_recording.setdefault(advice.recording, []).append(name)
    return "".join(
        f" Untestable here: {', '.join(names)}; a second recording {words} would show it."
        for words, names in by_recording.items()
    )


def _others(steps: Sequence[Step]) -> str:
    others = [f"{step.name}: {other.name}" for step in steps for other in step.alternatives]
    return f" (not told apart from {', '.join(others)})" if others else ""


def _limit(diagnosis: Diagnosis) -> str:
    limits = diagnosis.mdb.get("companion"), diagnosis.mdb.get("vibration")
    words = []
    if limits[0]:
        words.append(f"a companion of {limits[0]['flux_ratio']:.1g}")
    if limits[1]:
        words.append(f"a vibration of {limits[1]['sigma_mas']:.1f} mas")
    return f" above {' or '.join(words)}" if words else ""
