"""Named parameters of an image fit, and the vector that a solver sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from irlos_pipe.effects.declaration import Parameter

INFINITE = float("inf")


@dataclass(frozen=True)
class Layout:
    """Order of the parameters: Zernike modes, effect parameters, flux, background.

    Attributes
    ----------
    nolls : tuple of int
    effects : tuple of Parameter
        Free parameters of the effects; empty where they are held.
    prior_mean_nm, prior_sigma_nm : tensor, (modes,) or (batch, modes), optional
        Gaussian prior of the modes; no prior when absent.
    """

    nolls: tuple[int, ...]
    effects: tuple[Parameter, ...] = ()
    prior_mean_nm: torch.Tensor | None = None
    prior_sigma_nm: torch.Tensor | None = field(default=None)

    @property
    def modes(self) -> slice:
        """Columns of the Zernike coefficients [nm]."""
        return slice(0, len(self.nolls))

    @property
    def effect_values(self) -> slice:
        """Columns of the effect parameters."""
        return slice(len(self.nolls), len(self.nolls) + len(self.effects))

    @property
    def size(self) -> int:
        """Number of parameters; the last two are flux and background [e-]."""
        return len(self.nolls) + len(self.effects) + 2

    @property
    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Lower and upper bounds, (size,) each."""
        lower = torch.full((self.size,), -INFINITE, dtype=torch.float64)
        upper = -lower
        lower[self.effect_values] = torch.tensor([p.lower for p in self.effects], dtype=torch.float64)
        upper[self.effect_values] = torch.tensor([p.upper for p in self.effects], dtype=torch.float64)
        return lower, upper

    def prior(self, batch: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the prior mean and precision (1/σ², 0 where there is none), (batch, size) each."""
        mean = torch.zeros(batch, self.size, dtype=torch.float64)
        precision = torch.zeros_like(mean)
        if self.prior_sigma_nm is not None:
            precision[:, self.modes] = self.prior_sigma_nm.double() ** -2
        if self.prior_mean_nm is not None:
            mean[:, self.modes] = self.prior_mean_nm.double()
        mean[:, self.effect_values] = torch.tensor([p.prior_mean for p in self.effects], dtype=torch.float64)
        precision[:, self.effect_values] = (
            torch.tensor([p.prior_sigma for p in self.effects], dtype=torch.float64) ** -2
        )
        return mean, precision

    def start(self, images_e: torch.Tensor, modes_nm: torch.Tensor | Sequence[float] = ()) -> torch.Tensor:
        """Return start vectors for images (batch, pixels): flux from the sum, effects from their declaration.

        Parameters
        ----------
        images_e : tensor, (batch, pixels)
        modes_nm : tensor, (batch, modes) or (modes,), optional
            Start of the Zernike coefficients; zero by default.
        """
        x = torch.zeros(len(images_e), self.size, dtype=torch.float64)
        if len(modes_nm):
            x[:, self.modes] = torch.as_tensor(modes_nm, dtype=torch.float64)
        x[:, self.effect_values] = torch.tensor([p.start for p in self.effects], dtype=torch.float64)
        x[:, -2] = images_e.double().sum(1).cpu()
        return x
