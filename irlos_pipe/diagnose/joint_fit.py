"""One wavefront and one set of effects fitted to the mean images of several recordings.

Tip, tilt, flux and background are those of each recording. The parameter vector is that of the first
recording with the other recordings' own numbers between the effects and its flux and background.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch

from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.problem import CHI2_TOLERANCE, CheapGradientProblem

OWN = 4  # tip, tilt, flux and background


class JointFit(CheapGradientProblem):
    """Least-squares problem for the solver; one member.

    Parameters
    ----------
    parts : sequence of ImageFit
        One per recording, with the same modes, Noll 2 and 3 first, and the same effect parameters.
    tolerance : float
        Fall of χ² still ahead at which the fit is done, in units of χ²/ν where the model misfits.
    """

    def __init__(self, parts: Sequence[ImageFit], tolerance: float = CHI2_TOLERANCE):
        self.parts, self.tolerance = tuple(parts), tolerance
        self.model, self.layout = parts[0].model, parts[0].layout
        shared, more = self.layout.size - 2, OWN * (len(parts) - 1)
        self.size = shared + more + 2
        self.columns = [[*range(shared), self.size - 2, self.size - 1]]
        for begin in range(shared, shared + more, OWN):
            tip, tilt, flux, background = range(begin, begin + OWN)
            self.columns.append([tip, tilt, *range(2, shared), flux, background])
        ends = torch.tensor([0, *(part.images.shape[-1] for part in parts)]).cumsum(0).tolist()
        self.pixels = [slice(a, b) for a, b in pairwise(ends)]
        good = sum(int((part.root_weight > 0).sum()) for part in parts)
        self.freedom = max(1, good - self.size)
        self.lower, self.upper = (self._spread(bound) for bound in ("lower", "upper"))
        self.prior_mean, self.prior_precision = (
            self._spread(name, 0)[None] for name in ("prior_mean", "prior_precision")
        )

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns, the same in all recordings."""
        return self.model.psf.settings.window

    @property
    def own(self) -> list[int]:
        """Columns of what belongs to single recordings, four after the other for each."""
        return [columns[i] for columns in self.columns for i in (0, 1, -2, -1)]

    def part(self, x: torch.Tensor, number: int) -> torch.Tensor:
        """Parameter vector of recording `number`, (1, its parameters), out of the whole vector `x`."""
        return x[:, self.columns[number]]

    # -- Problem -----------------------------------------------------------------------------

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """See `ImageFit.negligible`."""
        return self.tolerance * (2 * value / self.freedom).clamp_min(1.0)

    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """See `Problem.objective`: half of χ² plus that of the prior, (1,)."""
        value = _half_chi2(x - self.prior_mean, self.prior_precision)
        for number, part in enumerate(self.parts):
            at = self.part(x, number)
            own_prior = _half_chi2(at - part.prior_mean, part.prior_precision)
            value = value + part.objective(at, which) - own_prior
        return value

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        """See `Problem.normal_equations`: with the Gauss–Newton Hessian."""
        offset = x - self.prior_mean
        value = _half_chi2(offset, self.prior_precision)
        gradient, hessian = self.prior_precision * offset, torch.diag_embed(self.prior_precision)
        for number, (part, columns) in enumerate(zip(self.parts, self.columns, strict=True)):
            at = self.part(x, number)
            own_value, own_gradient, own_hessian = part.normal_equations(at, which)
            precision, miss = part.prior_precision, at - part.prior_mean
            value = value + own_value - _half_chi2(miss, precision)
            gradient[:, columns] += own_gradient - precision * miss
            rows = torch.tensor(columns)
            hessian[:, rows[:, None], rows] += own_hessian - torch.diag_embed(precision)
        return value, gradient, hessian

    # -- images ------------------------------------------------------------------------------

    def predict(self, x: torch.Tensor) -> torch.Tensor:
        """Mean images of all recordings [e-], one after the other, (pixels,)."""
        pairs = enumerate(self.parts)
        return torch.cat([part.predict(self.part(x, number))[0].cpu() for number, part in pairs])

    def predict_and_jacobian(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean images (pixels,) and derivatives (parameters, pixels)."""
        images, jacobian = [], torch.zeros(self.size, self.pixels[-1].stop, dtype=torch.float64)
        for number, (part, columns) in enumerate(zip(self.parts, self.columns, strict=True)):
            image, own = part.predict_and_jacobian(self.part(x, number))
            images.append(image[0].cpu())
            jacobian[columns, self.pixels[number]] = own[0].cpu().double()
        return torch.cat(images), jacobian

    @torch.no_grad()
    def chi2(self, x: torch.Tensor) -> torch.Tensor:
        """χ² of all mean images together at `x`."""
        left = (part.reduced_chi2(self.part(x, n))[0] * part.freedom for n, part in enumerate(self.parts))
        return torch.stack(list(left)).sum()

    def _spread(self, name: str, member: int | None = None) -> torch.Tensor:
        """A number per parameter of the parts as one vector; what they share is that of the first."""
        spread = torch.zeros(self.size, dtype=torch.float64)
        for part, columns in reversed(list(zip(self.parts, self.columns, strict=True))):
            own = getattr(part, name)
            spread[columns] = own if member is None else own[member]
        return spread


def _half_chi2(offset: torch.Tensor, precision: torch.Tensor) -> torch.Tensor:
    """Half the χ² of parameters against their prior, (1,)."""
    return 0.5 * (precision * offset**2).sum(1)
