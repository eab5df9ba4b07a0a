"""Which effects LIFT has in its model, and how: as calibrated, as expected, or fitted to the ramp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from irlos_pipe.effects import Effect, FixedEffect, SeeingHalo, TipTiltJitter, expected


def ramp_effects(
    available: Sequence[Effect],
    known: Mapping[str, FixedEffect],
    halo: str = "calibrated",
    object_sigma_mas: str | float = "calibrated",
) -> list[Effect]:
    """Effects for `fit_ramp`.

    Parameters
    ----------
    available : sequence of Effect
        The effects of the model.
    known : mapping of str to FixedEffect
        Those that a calibration has measured, by name. Of the others, residual and jitter are taken as
        expected, and the rest as `available` has them: a free one is fitted to the whole ramp.
    halo : {"calibrated", "fit", "off"}
    object_sigma_mas : {"calibrated", "fit"} or float
        Size of the Gaussian kernel that stands for object and jitter.
    """
    best = {effect.name: known.get(effect.name) or expected([effect])[0] for effect in available}
    residual = _halo(best.pop(SeeingHalo.name, None), halo)
    kernel = _kernel(best.pop(TipTiltJitter.name, None), object_sigma_mas)
    rest = [known.get(effect.name, effect) for effect in available if effect.name in best]
    return [effect for effect in (residual, kernel, *rest) if effect is not None]


def _halo(best: FixedEffect | None, halo: str) -> Effect | None:
    if halo == "off" or best is None:
        return None
    return FixedEffect(best.base, best.values, free=("variance_nm2",)) if halo == "fit" else best


def _kernel(best: FixedEffect | None, object_sigma_mas: str | float) -> Effect | None:
    if object_sigma_mas == "calibrated":
        return best
    jitter = TipTiltJitter()
    return jitter if object_sigma_mas == "fit" else FixedEffect(jitter, jitter.values_of(object_sigma_mas))
