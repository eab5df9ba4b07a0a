"""Image models with their images in a table, for many fits of tip, tilt and focus with one light path."""

from __future__ import annotations

import torch

from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.starts import SCAN_NM
from irlos_pipe.optics.focus_table import FocusTable, Reach, can_tabulate, is_family, place_of_focus

FOCUS_REACH_NM = 400.0  # beyond the starts; few fits move further
TILT_REACH_NM = 250.0  # between two and three pixels


class TabulatedModel(ImageModel):
    """An `ImageModel` without free parameters, quick within a reach.

    Parameters
    ----------
    general : ImageModel
    reach : Reach
    """

    def __init__(self, general: ImageModel, reach: Reach):
        psf = FocusTable(general.psf, general.optics, reach)
        detector = [effect for effect, _ in general.effects.at("detector")]
        super().__init__(psf, EffectSet(detector, general.psf.grids))
        self._general = general

    @property
    def general(self) -> ImageModel:
        """What was tabulated."""
        return self._general


def tabulated(model: ImageModel, start_nm: torch.Tensor) -> ImageModel:
    """A quick version of `model` about `start_nm`, (images, modes); `model` itself where there is none.

    There is one if the modes are tip, tilt and one more, if no effect is free or changes with time, and
    if the images are well sampled.
    """
    if model.general is not model or model.effects.parameters or model.effects.at("time"):
        return model
    if not is_family(model.psf.nolls) or model.psf.settings.lenslets > 1:
        return model
    reach = _reach(model.psf.nolls, start_nm)
    return TabulatedModel(model, reach) if can_tabulate(model.psf, model.optics, reach) else model


def _reach(nolls: tuple[int, ...], start_nm: torch.Tensor) -> Reach:
    """Limits well beyond the starts, wide enough for the scan of `scan_start_nm` too."""
    focus = start_nm[:, place_of_focus(nolls)]
    low = min(float(focus.min()) - FOCUS_REACH_NM, SCAN_NM[0])
    high = max(float(focus.max()) + FOCUS_REACH_NM, SCAN_NM[-1])
    tilts = start_nm[:, [nolls.index(2), nolls.index(3)]]
    return Reach((low, high), float(tilts.abs().max()) + TILT_REACH_NM)
