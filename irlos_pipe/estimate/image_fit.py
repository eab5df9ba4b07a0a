"""Fit of the PSF model to images, as a least-squares problem for the batched solver.

One problem serves every estimator: a batch of images, each explained by its own parameter
vector (`dip_global`, `lift_slices`, LIFT on a ramp), one image by one vector (the mean-image
methods), or many images by one vector (`dip_joint`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch

from irlos_pipe.effects import EffectSet
from irlos_pipe.effects.declaration import Parameter
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.numerics.directional import along_all
from irlos_pipe.numerics.loss import GAUSSIAN, Loss, normal_equations, robust_equations
from irlos_pipe.numerics.parallel import at_once, joined_map
from irlos_pipe.numerics.solver import CHI2_TOLERANCE, Problem, Solution, scaled_inverse
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import PsfSettings

FRAMES_PER_CHUNK = 8
FRAMES_PER_GRADIENT = 16
OF_IMAGES = ("model", "few_colours")  # what images and derivatives depend on, besides the parameters
MOST_LEVERAGE = 0.9  # leverage of a pixel on its own fit beyond which nothing is known of its noise
# of a fit, some vectors and their members
Piece = Callable[[Any, torch.Tensor, torch.Tensor], tuple[torch.Tensor, ...]]


class ImageFit(Problem):
    """Images against those of an `ImageModel`; never changed, methods return changed copies.

    The modes of the model's PSF are the fitted ones. Its free effect parameters are either those of
    `layout.effects`, fitted along in a batch of one, or stay where they start. The data `images_e` are
    (batch, repeats, pixels), those along `repeats` share one parameter vector; their variance, broadcastable
    to them, is infinite for masked pixels.
    """

    per_member: tuple[str, ...] = ("images", "root_weight", "prior_mean", "prior_precision")
    # from which images and derivatives of linearisations are, where they may be rough
    few_colours: ImageModel | None = None
    # the last place of a single member, images and derivatives there
    known: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None

    def __init__(
        self,
        model: ImageModel,
        layout: Layout,
        images_e: torch.Tensor,
        variance_e2: torch.Tensor,
        *,
        loss: Loss = GAUSSIAN,
    ):
        self.model, self.layout, self.loss = model, layout, loss
        self.reweighted, self.tolerance, self.same_unit = not loss.quadratic, CHI2_TOLERANCE, layout.modes
        self.images = images_e
        self.device = model.psf.device
        self.root_weight = self._root_weight(variance_e2)
        self.freedom = max(
            1,
            int((self.root_weight[0] > 0).sum()) * images_e.shape[1] // self.root_weight.shape[1]
            - layout.size,
        )
        self.lower, self.upper = self._bounds(model)
        self.prior_mean, self.prior_precision = layout.prior(len(images_e))
        self.has_prior = bool(self.prior_precision.any())

    def _root_weight(self, variance_e2: torch.Tensor) -> torch.Tensor:
        """Square root of the weight per pixel; a loss in plain electrons uses the median variance."""
        root = variance_e2.double() ** -0.5
        if not self.loss.whitened:
            good = root > 0
            root = torch.where(good, root[good].median(), 0.0)
        return root.to(self.images.dtype).expand(self.images.shape[0], -1, self.images.shape[2])

    def _bounds(self, model: ImageModel) -> tuple[torch.Tensor, torch.Tensor]:
        """Least and largest parameters, those of the layout and of the model."""
        limits_nm, modes = model.limits_nm, self.layout.modes
        lower, upper = (one.expand(*limits_nm.shape[1:-1], -1).clone() for one in self.layout.bounds)
        lower[..., modes], upper[..., modes] = limits_nm
        return lower, upper

    def with_model(self, model: ImageModel) -> Self:
        """Return the same images with another `model` of the same parameters."""
        lower, upper = self._bounds(model)
        return self._with(model=model, lower=lower, upper=upper)

    def posed(self, model: ImageModel, layout: Layout) -> ImageFit:
        """Return the fit of the same images by a `model` of other parameters, those of a `layout`."""
        return ImageFit(model, layout, self.images, self.root_weight.double() ** -2, loss=self.loss)

    def carried(self, x: torch.Tensor, other: ImageFit) -> torch.Tensor:
        """Return where these fits, at `x` (batch, parameters), are in `other` ones, (batch, its parameters).

        The modes of both begin with the same one; effects go by their labels. Modes that are lacking are 0,
        and parameters of effects that are not free here begin as declared.
        """
        old, new, own, effects = self.layout, other.layout, self.model.effects, other.model.effects
        there = new.start(x[:, -2:-1])
        common = min(len(old.nolls), len(new.nolls))
        there[:, :common], there[:, -1] = x[:, :common], x[:, -1]
        known, free = x[:, old.effect_values], there[:, new.effect_values]
        for label in set(own.labels).intersection(effects.labels) if old.effects else ():
            if columns := own.columns_of(label):
                free[:, effects.columns_of(label)] = known[:, columns]
        return there

    def with_loss(self, loss: Loss) -> Self:
        """Return the same images with another loss, and with one in plain electrons with its weights.

        From such a loss there is no way back to others: it forgets the variances.
        """
        other = self._with(loss=loss, reweighted=not loss.quadratic)
        if self.loss.whitened and not loss.whitened:
            other.root_weight = other._root_weight(self.root_weight.double() ** -2)
        return other

    def members(self, which: torch.Tensor) -> Self:
        """Return the fits of some members only."""
        return self._with(**{name: getattr(self, name)[which] for name in self.per_member})

    def with_tolerance(self, tolerance: float) -> Self:
        """Return the same fits, done where less than this fall of χ² is ahead, see `negligible`."""
        return self._with(tolerance=tolerance)

    def _with(self, **changes: Any) -> Self:
        other = copy(self)
        vars(other).update(changes)
        if not changes.keys().isdisjoint(OF_IMAGES):
            other.known = None
        return other

    # -- Problem -----------------------------------------------------------------------------

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return the fall of χ² that no longer matters: errors being scaled by √(χ²/ν), a part of χ²/ν."""
        scatter = (2 * value / self.freedom).clamp_min(1.0)
        return torch.maximum(self.tolerance * scatter, self.loss.relative_tolerance * value)

    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """See `Problem.objective`: the loss summed over pixels plus the prior's half χ²."""
        return self._map(ImageFit._objective, x, which)[0] + self._prior_value(x, which)

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        value, gradient, hessian = self._map(ImageFit._normal, x, which)
        return value + self._prior_value(x, which), gradient, hessian

    def gradient(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Descent.gradient`; without free effects, at the cost of two images."""
        value, gradient = self._map(ImageFit._gradient, x, which, FRAMES_PER_GRADIENT)
        if self.has_prior:
            precision, offset = self._prior(x, which)
            gradient += precision * offset
        return value + self._prior_value(x, which), gradient

    def _map(
        self, function: Piece, x: torch.Tensor, which: torch.Tensor, size: int = FRAMES_PER_CHUNK
    ) -> tuple[torch.Tensor, ...]:
        """What `function` makes of pieces of a few members, small enough for the processor's cache.

        It may work on another device than that of `x`, where the results are.
        """
        size = at_once(size, self.device)
        if len(x) <= size:
            found = function(self._of(which), x, which)
        else:
            pieces = zip(x.split(size), which.split(size), strict=True)
            found = joined_map(lambda piece: function(self._of(piece[1]), *piece), pieces, len(x))
        return tuple(one.to(x.device) for one in found)

    def _of(self, which: torch.Tensor) -> Self:
        """The fit with the model of some members, where theirs differ."""
        return self

    def _prior_value(self, x, which):
        if not self.has_prior:
            return 0.0
        precision, offset = self._prior(x, which)
        return 0.5 * (precision * offset**2).sum(1)

    def _prior(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Precision of the prior and offset from its mean, where `x` is."""
        which = which.to(self.prior_mean.device)
        return self.prior_precision[which].to(x.device), x - self.prior_mean[which].to(x.device)

    # -- images ------------------------------------------------------------------------------

    def predict(self, x: torch.Tensor) -> torch.Tensor:
        """Return the model images [e-], (b, pixels), float64 on the model's device."""
        return self.model.predict(*self._arguments(x)).flatten(1)

    def predict_and_jacobian(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the model images [e-], (b, pixels), float64, and derivatives (b, parameters, pixels)."""
        known = self.known
        if known is not None and torch.equal(known[0], x):
            return known[1], known[2]
        model = self.few_colours or self.model
        image, columns = model.predict_and_jacobian(*self._arguments(x), held=not self.layout.effects)
        found = image.flatten(1), columns.flatten(2)
        self.known = (x.clone(), *found) if len(x) == 1 else None
        return found

    def curvature_weights(self, x: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
        """Return the weights of the pixels in the Hessian at `x`, (members, pixels), float64.

        Over images that share a member they are summed; those of a robust loss hold its curvature. The
        model's images at `x` (members, parameters) are `model_e` (members, pixels).
        """
        residual, root = self._whitened(model_e, torch.arange(len(x)))
        if self.loss.quadratic:
            return (root**2).expand_as(residual).sum(1).cpu()
        return (self.loss.curvature(residual) * root**2).sum(1).cpu()

    def _arguments(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Modes, flux, background and effect parameters, in the order of `ImageModel.predict`."""
        layout = self.layout
        values = x[0, layout.effect_values].cpu() if layout.effects else self.model.effects.starts
        return x[:, layout.modes].to(self.device), x[:, -2], x[:, -1], values

    def _whitened(self, model_e: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Whitened residuals (b, repeats, pixels) and the square roots of the weights."""
        which = which.to(self.images.device)
        root = self.root_weight[which].double()
        return (self.images[which].double() - model_e[:, None]) * root, root

    def _objective(self, x, which):
        model_e = self.predict(x)
        residual, _ = self._whitened(model_e, which)
        return (self._value(residual, model_e, which),)

    def _value(self, residual: torch.Tensor, model_e: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """Objective without the prior, (b,)."""
        return self.loss.value(residual).sum((1, 2))

    def _gradient(self, x, which):
        """Without the prior; pixels in the precision of the images."""
        modes_nm = x[:, self.layout.modes].to(self.device)
        image, pullback = self.model.predict_and_pullback(modes_nm, x[:, -2], x[:, -1])
        which = which.to(self.device)
        root = self.root_weight[which]
        residual = (self.images[which] - image.flatten(1)[:, None]) * root
        force = (self.loss.weight(residual) * residual * root).sum(1)
        value = self.loss.value(residual).sum((1, 2), dtype=torch.float64)
        return value, -pullback(force.view_as(image))

    def _normal(self, x, which):
        model_e, columns = self.predict_and_jacobian(x)
        residual, root = self._whitened(model_e, which)
        precision, offset = (one.to(columns.device) for one in self._prior(x, which))
        if self.loss.quadratic:
            gradient, hessian = normal_equations(columns, residual, root)
            if self.has_prior:
                gradient += precision * offset
                hessian += torch.diag_embed(precision)
        else:
            gradient, hessian = robust_equations(columns, residual, root, self.loss, precision, offset)
        return self._value(residual, model_e, which), gradient, hessian

    @torch.no_grad()
    def robust_covariance(self, x: torch.Tensor) -> torch.Tensor:
        """Covariance of estimates by a loss that is not the likelihood, (batch, parameters, parameters).

        ``(JᵀDJ + P)⁻¹ (JᵀSJ + P) (JᵀDJ + P)⁻¹`` with derivatives J of the images, the slope D of ψ = ρ' at
        the residuals, the prior's precision P, and S = ψ²/(1 − h)², as a pixel of leverage h follows its own
        noise (Huber 1967, Proc. 5th Berkeley Symp. 1, 221; MacKinnon & White 1985, J. Econom. 29, 305).

        Errors of L1 come out 6 % too small: its slope is that of few pixels, which happen to be met exactly.
        """
        return self._map(ImageFit._robust_covariance, x, torch.arange(len(x)))[0]

    def _robust_covariance(self, x, which):
        model_e, columns = self.predict_and_jacobian(x)
        residual, root = self._whitened(model_e, which)
        prior, columns = torch.diag_embed(self.prior_precision[which]), columns.double()

        def summed(weight: torch.Tensor) -> torch.Tensor:
            return ((columns * weight[:, None]) @ columns.mT).cpu() + prior

        slope = (self.loss.slope(residual) * root**2).sum(1)
        square = ((self.loss.weight(residual) * residual * root) ** 2).sum(1)
        inverse = scaled_inverse(summed(slope))
        leverage = slope * (columns * (inverse.to(columns.device) @ columns)).sum(1)
        return (inverse @ summed(square / (1 - leverage.clamp(0, MOST_LEVERAGE)) ** 2) @ inverse,)

    # -- quality -----------------------------------------------------------------------------

    @torch.no_grad()
    def reduced_chi2(self, x: torch.Tensor) -> torch.Tensor:
        """Return χ² per degree of freedom of every member, (batch,), from the variances given."""
        return self.reduced_chi2_of(self.predict_all(x))

    @torch.no_grad()
    def reduced_chi2_of(self, predicted_e: torch.Tensor) -> torch.Tensor:
        """Return the same of images of the model, (batch, pixels)."""

        def reduced(fit: ImageFit, part: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor]:
            residual, _ = fit._whitened(part.to(fit.device), which)
            return (residual.square().sum((1, 2), dtype=torch.float64) / self.freedom,)

        return self._map(reduced, predicted_e, torch.arange(len(predicted_e)))[0]

    @torch.no_grad()
    def predict_all(self, x: torch.Tensor) -> torch.Tensor:
        """Return the model images of the whole batch [e-], (batch, pixels), float64 where `x` is."""
        return self._map(lambda fit, part, _: (fit.predict(part),), x, torch.arange(len(x)))[0]


@dataclass(frozen=True)
class Fit:
    """A problem and where its fit ended; numbers are those of its first member."""

    problem: ImageFit
    solution: Solution

    @property
    def x(self) -> torch.Tensor:
        """Parameters, (1, parameters)."""
        return self.solution.values[:1]

    @property
    def chi2_nu(self) -> float:
        """χ²/ν by its own weights."""
        return float(self.problem.reduced_chi2(self.x)[0])

    @property
    def objective(self) -> float:
        return float(self.solution.objective[0])


class JoinedFit(Problem):
    """Fits of several recordings by one vector; one member.

    The `parts`, of one member each, have the same modes. For each of them `columns` say where its parameters
    stand in the whole vector, of which parts may share some, and `changes` to which of these by number a
    further one is added, and where that stands: the prior standard errors of these, about 0, are `sigma`, by
    place in the whole vector.
    """

    def __init__(
        self,
        parts: Sequence[ImageFit],
        columns: Sequence[Sequence[int]],
        changes: Sequence[Mapping[int, int]],
        sigma: Mapping[int, float],
        tolerance: float = CHI2_TOLERANCE,
    ):
        self.parts, self.own, self.tolerance = tuple(parts), columns, tolerance
        self.rows = [[*range(len(own)), *more] for own, more in zip(columns, changes, strict=True)]
        self.columns = [[*own, *more.values()] for own, more in zip(columns, changes, strict=True)]
        self.size = 1 + max(column for one in self.columns for column in one)
        self.layout = parts[0].layout
        good = sum(int((part.root_weight > 0).sum()) for part in parts)
        self.freedom = max(1, good - self.size)
        self.lower, self.upper = (
            self.whole([getattr(p, name) for p in parts]) for name in ("lower", "upper")
        )
        self.prior_mean, self.prior_precision = (
            self.whole([getattr(p, name)[0] for p in parts])[None]
            for name in ("prior_mean", "prior_precision")
        )
        for column, own_sigma in sigma.items():
            self.lower[column], self.upper[column] = -INFINITE, INFINITE
            self.prior_precision[:, column] = own_sigma**-2

    def whole(self, of_parts: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the whole vector of numbers per parameter of each part; what they share is the first's."""
        spread = torch.zeros(self.size, dtype=torch.float64)
        for columns, values in reversed(list(zip(self.own, of_parts, strict=True))):
            spread[columns] = values
        return spread

    def part(self, x: torch.Tensor, number: int) -> torch.Tensor:
        """Return the parameters of the part `number`, (1, its parameters), out of the whole vector `x`."""
        own = torch.zeros(1, len(self.own[number]), dtype=torch.float64)
        return own.index_add(1, torch.tensor(self.rows[number]), x[:, self.columns[number]])

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        return self.tolerance * (2 * value / self.freedom).clamp_min(1.0)

    def chi2(self, x: torch.Tensor) -> float:
        """Return χ² of all images."""
        parts = enumerate(self.parts)
        return sum(float(part.reduced_chi2(self.part(x, n))[0]) * part.freedom for n, part in parts)

    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """Half of χ² plus that of the prior, (1,)."""
        value = _half_chi2(x - self.prior_mean, self.prior_precision)
        for number, part in enumerate(self.parts):
            at = self.part(x, number)
            own_prior = _half_chi2(at - part.prior_mean, part.prior_precision)
            value = value + part.objective(at, which) - own_prior
        return value

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        """With the Gauss–Newton Hessian; the priors of the parts are replaced by those of the whole."""
        offset = x - self.prior_mean
        value = _half_chi2(offset, self.prior_precision)
        gradient, hessian = self.prior_precision * offset, torch.diag_embed(self.prior_precision)
        for number, part in enumerate(self.parts):
            at, rows = self.part(x, number), self.rows[number]
            own_value, own_gradient, own_hessian = part.normal_equations(at, which)
            precision, miss = part.prior_precision, at - part.prior_mean
            value = value + own_value - _half_chi2(miss, precision)
            columns = torch.tensor(self.columns[number])
            gradient[:, columns] += (own_gradient - precision * miss)[:, rows]
            curvature = own_hessian - torch.diag_embed(precision)
            hessian[:, columns[:, None], columns] += curvature[:, rows][:, :, rows]
        return value, gradient, hessian


def _half_chi2(offset: torch.Tensor, precision: torch.Tensor) -> torch.Tensor:
    """Half the χ² of parameters against their prior, (1,)."""
    return 0.5 * (precision * offset**2).sum(1)


def like(psf: LightPath, settings: PsfSettings, nolls: Sequence[int]) -> LightPath:
    """Return the light path of other settings and modes, computed where and as precisely as `psf`."""
    return light_path(settings, nolls, device=psf.device, dtype=psf.dtype, rough_derivatives=True)


def masked_variance(variance_e2: torch.Tensor, good: torch.Tensor) -> torch.Tensor:
    """Return `variance_e2` with infinity where `good` is False: bad pixels carry no weight."""
    return torch.where(good.to(variance_e2.device), variance_e2, math.inf)


INFINITE = float("inf")


@dataclass(frozen=True)
class Layout:
    """Order of the parameters: Zernike modes, effect parameters, flux, background."""

    nolls: tuple[int, ...]
    effects: tuple[Parameter, ...] = ()  # free parameters; empty where they are held
    # (modes,) or (batch, modes), both or none: Gaussian prior of the modes
    prior_mean_nm: torch.Tensor | None = None
    prior_sigma_nm: torch.Tensor | None = None

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

        Zernike coefficients start at `modes_nm`, (batch, modes) or (modes,); by default at zero.
        """
        x = torch.zeros(len(images_e), self.size, dtype=torch.float64)
        if len(modes_nm):
            x[:, self.modes] = torch.as_tensor(modes_nm, dtype=torch.float64)
        x[:, self.effect_values] = torch.tensor([p.start for p in self.effects], dtype=torch.float64)
        x[:, -2] = images_e.double().sum(1).cpu()
        return x


def effects_in_modes_nm(
    effects: EffectSet, values: torch.Tensor, nolls: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the part of each mode that the effects hold, (modes,), and its derivatives.

    These are (modes, effect parameters), at `values` (effect parameters,). Petals, bumps and high orders are
    not orthogonal to the modes on an obscured pupil: the effects' OPD is projected on piston and the modes by
    least squares over the clear pupil.
    """
    if not effects.at("pupil"):
        return torch.zeros(len(nolls)), torch.zeros(len(nolls), len(values))
    grid = effects.grids.pupil
    weight = np.clip(grid.amplitude.ravel() / grid.light, 0, 1)
    basis = grid.modes([1, *nolls]).reshape(len(nolls) + 1, -1)
    project = torch.as_tensor(np.linalg.solve((basis * weight) @ basis.T, basis * weight)[1:])

    def modes(v: torch.Tensor) -> torch.Tensor:
        return project @ effects.opd_nm(v).flatten()

    return modes(values), along_all(modes, values).mT if len(values) else torch.zeros(len(nolls), 0)


def whole_wavefront(problem: ImageFit, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what effects add to the modes, (modes,), and the derivatives of their sum, (modes, parameters).

    The parameters are `x` (parameters,).
    """
    layout = problem.layout
    added, slopes = effects_in_modes_nm(problem.model.effects, x[layout.effect_values], layout.nolls)
    derivatives = torch.zeros(len(layout.nolls), layout.size, dtype=torch.float64)
    derivatives[:, layout.modes] = torch.eye(len(layout.nolls), dtype=torch.float64)
    derivatives[:, layout.effect_values] = slopes.double()
    return added, derivatives
