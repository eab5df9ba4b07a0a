"""Which effects LIFT has in its model, and how: as calibrated, as expected, or fitted to the ramp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..effects import OtfEffect, Pinned, SeeingHalo, TipTiltJitter, expected


def ramp_effects(
    available: Sequence[OtfEffect],
    known: Mapping[str, Pinned],
    halo: str = "calibrated",
    object_sigma_mas: str | float = "calibrated",
) -> list[OtfEffect]:
    """Effects for `fit_ramp`.

    Parameters
    ----------
    available : sequence of OtfEffect
        The effects of the model.
    known : mapping of str to Pinned
        Those that a calibration has measured, by name; the others are taken as expected.
    halo : {"calibrated", "fit", "off"}
    object_sigma_mas : {"calibrated", "fit"} or float
        Size of the Gaussian kernel that stands for object and jitter.
    """
    best = {effect.name: known.get(effect.name) or expected([effect])[0] for effect in available}
    residual = _halo(best.get(SeeingHalo.name), halo)
    kernel = _kernel(best.get(TipTiltJitter.name), object_sigma_mas)
    return [effect for effect in (residual, kernel) if effect is not None]


def _halo(best: Pinned | None, halo: str) -> OtfEffect | None:
    if halo == "off" or best is None:
        return None
    return Pinned(best.effect, best.values, free=("variance_nm2",)) if halo == "fit" else best


def _kernel(best: Pinned | None, object_sigma_mas: str | float) -> OtfEffect | None:
    if object_sigma_mas == "calibrated":
        return best
    jitter = TipTiltJitter()
    return jitter if object_sigma_mas == "fit" else Pinned(jitter, jitter.values_of(object_sigma_mas))
