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
    """Unit-flux images of a point source, and their derivatives, for batches of wavefronts.

    Attributes
    ----------
    settings : PsfSettings
    nolls : tuple of int
        Zernike modes that the coefficients refer to.
    device : str
    dtype : torch.dtype
        Of the propagation.
    """

    settings: PsfSettings
    nolls: tuple[int, ...]
    device: str
    dtype: torch.dtype

    @property
    def grids(self) -> Grids:
        """Where effects can act, for `effects.EffectSet`."""

    @property
    def limits_nm(self) -> torch.Tensor:
        """Least and largest coefficients that the model is good for, (2, modes)."""

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> LightPath:
        """Return the light path to another `window`; `margin_mas`, `halo_margin_mas` as of `PsfSettings`."""

    def images(self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        """Return the unit-flux images; differentiable by autograd as well.

        Parameters
        ----------
        modes_nm : tensor, (frames, modes)
        optics : Optics
            What effects make of the light path, see `effects.EffectSet`.

        Returns
        -------
        tensor, (frames, rows, columns)
        """

    def images_and_jacobian(
        self,
        modes_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return images and their derivatives.

        Parameters
        ----------
        modes_nm : tensor, (frames, modes)
        optics : see `images`
        tangents : Tangents
            Derivatives of pupil, OTF factors and sampling with respect to effect parameters.
        modal : bool
            False leaves the derivatives with respect to the modes out.

        Returns
        -------
        images : tensor, (frames, rows, columns)
        jacobian : tensor, (frames, modes + parameters, rows, columns)
            First the modes [1/nm], then the parameters in the pupil, of the OTF, and of the sampling.
        """

    def images_and_pullback(
        self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT
    ) -> tuple[torch.Tensor, Pullback]:
        """Return images and the transpose of their Jacobian.

        Parameters
        ----------
        modes_nm, optics : see `images`

        Returns
        -------
        images : tensor, (frames, rows, columns)
        pullback : callable
            From factors of all pixels, (frames, rows, columns), to the derivatives of the images' sum
            with these factors, (frames, modes) [1/nm].
        """
