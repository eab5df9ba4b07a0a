"""What the images of a star come from: the propagated model, or a table of its images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch

from irlos_pipe.optics.grids import Grids, Optics, Tangents
from irlos_pipe.optics.psf_settings import PsfSettings

AS_BUILT, NO_TANGENTS = Optics(), Tangents()
Pullback = Callable[[torch.Tensor], torch.Tensor]


class LightPath(Protocol):
    """Unit-flux images of a point source, and their derivatives, for batches of wavefronts."""

    settings: PsfSettings
    nolls: tuple[int, ...]  # Zernike modes that the coefficients refer to
    device: str
    dtype: torch.dtype  # of the propagation

    @property
    def grids(self) -> Grids:
        """Where effects can act, for `effects.EffectSet`."""

    @property
    def limits_nm(self) -> torch.Tensor:
        """Least and largest coefficients that the model is good for, (2, modes)."""

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> LightPath:
        """Return the light path to another `window`; `margin_mas`, `halo_margin_mas` as of `PsfSettings`."""

    def images(self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        """Return unit-flux images, (frames, rows, columns), of `modes_nm`, (frames, modes).

        What effects make of the light path is in `optics`, see `effects.EffectSet`. The images are
        differentiable by autograd as well.
        """

    def images_and_jacobian(
        self,
        modes_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the images and their derivatives, (frames, modes + parameters, rows, columns).

        First come the modes [1/nm], left out unless `modal`, then the parameters in the pupil, of the OTF,
        and of the sampling: `tangents` are the derivatives of pupil, OTF factors and sampling by these. The
        other arguments are those of `images`.
        """

    def images_and_pullback(
        self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT
    ) -> tuple[torch.Tensor, Pullback]:
        """Return the images and the transpose of their Jacobian, with the arguments of `images`.

        The transpose leads from factors of all pixels, (frames, rows, columns), to the derivatives of the
        images' sum with these factors, (frames, modes) [1/nm].
        """
