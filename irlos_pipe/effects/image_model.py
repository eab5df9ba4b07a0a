"""Electrons in every pixel: ``flux · PSF(modes, effects) + background``, as the detector shows them.

This is where the light path ends and estimation begins: a fit, a bound or a search sees images as
a function of Zernike modes, effect parameters, flux and background, and their derivatives, whatever the
plane in which an effect acts. Parameters in the pupil, of the OTF, of colours and pixel scale are
differentiated by the chain rule in their plane, those that change the wavefront's course in time by
automatic differentiation of the whole path.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.light_path import NO_TANGENTS, LightPath

TIMES = 3  # nodes of the average over a recording: exact for images of 5th order in time

NOTHING = torch.zeros(0, dtype=torch.float64)  # the parameter vector of effects that are all held


class ImageModel:
    """Images of a star of known brightness."""

    def __init__(self, psf: LightPath, effects: Sequence[Effect] | EffectSet = ()):
        self.psf = psf
        self.effects = effects if isinstance(effects, EffectSet) else EffectSet(effects, psf.grids)
        self._last: tuple[Tensor, Optics] | None = None

    def predict(
        self,
        modes_nm: Tensor,
        flux_e: Tensor,
        background_e: Tensor,
        values: Tensor = NOTHING,
        when: Tensor | None = None,
    ) -> Tensor:
        """Return images [e-], (images, rows, columns), float64 on the device of the PSF model.

        They have the wavefronts `modes_nm` (images, modes), `flux_e` electrons through the clear pupil and
        `background_e` in every pixel, (images,) each, and effects of the parameters `values`. The time `when`
        of every image, (images,), is 0 at the first frame and 1 at the last, and matters only to effects that
        change with it; by default each image is the average over the whole recording.
        """
        unit = self._unit(modes_nm, self._optics(values), values, when).double()
        image = flux_e[:, None, None].to(unit.device) * unit + background_e[:, None, None].to(unit.device)
        return self.effects.detect(values, image)

    def predict_and_jacobian(
        self,
        modes_nm: Tensor,
        flux_e: Tensor,
        background_e: Tensor,
        values: Tensor = NOTHING,
        when: Tensor | None = None,
        *,
        held: bool = False,
        modal: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Return images and derivatives, (images, modes + effect parameters + 2, rows, columns).

        Those by flux and background come last; those by the modes are left out unless `modal`, those by the
        effect parameters if these are `held`. Derivatives have the precision of the propagation unless the
        model has detector effects. The other arguments are those of `predict`.
        """
        unit, jacobian = self._unit_and_jacobian(modes_nm, values, when, held, modal)
        flux, background = (v[:, None, None].to(unit.device) for v in (flux_e, background_e))
        before = jacobian.shape[1]
        modes = len(self.psf.nolls) if modal else 0
        size = modes + (0 if held else len(values)) + 2
        columns = unit.new_empty(len(unit), size, *unit.shape[1:])
        torch.mul(jacobian, flux[:, None].to(unit.dtype), out=columns[:, :before])
        columns[:, before:-2] = 0
        columns[:, -2] = unit
        columns[:, -1] = 1.0
        image = flux * unit.double() + background
        if not self.effects.at("detector"):
            return image, columns
        seen, columns = self.effects.detect_with_changes(values, image, columns.double())
        if not held:
            change = Directional(lambda v: self.effects.detect(v, image), values)
            for index in self.effects.free_at("detector"):
                columns[:, modes + index] = change.by(index)
        return seen, columns

    def predict_and_pullback(self, modes_nm: Tensor, flux_e: Tensor, background_e: Tensor):
        """Images without free effects in the precision of the propagation, and the transposed Jacobian.

        The arguments are those of `predict`. The second is a function
        from factors of all pixels, (images, rows, columns), to the derivatives of the images' sum with these
        factors, (images, modes + 2), float64: modes, flux, background.

        Raises `ValueError` with free effects, or effects of the detector or of time.
        """
        if not self.can_pull_back:
            raise ValueError("the pullback knows no free effects, nor those of the detector or of time")
        unit, to_modes = self._unit_and_pullback(modes_nm)
        flux, background = (v.to(unit)[:, None, None] for v in (flux_e, background_e))

        def pullback(factors: Tensor) -> Tensor:
            by_flux = (factors * unit).sum((1, 2), dtype=torch.float64)
            by_background = factors.sum((1, 2), dtype=torch.float64)
            by_modes = to_modes(factors).double() * flux[:, :, 0].double()
            return torch.cat([by_modes, by_flux[:, None], by_background[:, None]], dim=1)

        return flux * unit + background, pullback

    @property
    def can_pull_back(self) -> bool:
        """Whether `predict_and_pullback` knows all effects of the model."""
        return not (self.effects.parameters or self.effects.at("detector") or self.effects.at("time"))

    @property
    def optics(self) -> Optics:
        """What effects without free parameters make of the light path."""
        return self._optics(NOTHING)

    @property
    def limits_nm(self) -> Tensor:
        """Least and largest coefficients for which the model holds, see `LightPath.limits_nm`."""
        return self.psf.limits_nm

    def at_limit(self, modes_nm: Tensor) -> Tensor:
        """Return which wavefronts (images, modes) have run into `limits_nm`, (images,)."""
        lower, upper = self.limits_nm
        return ((modes_nm <= lower) | (modes_nm >= upper)).any(1) & torch.isfinite(modes_nm).all(1)

    @property
    def general(self) -> "ImageModel":
        """The model without limits that this one may be a quick version of; here itself."""
        return self

    # -- parts -------------------------------------------------------------------------------

    def _optics(self, values: Tensor) -> Optics:
        """What the effects make of the light path, kept for the next call with the same values."""
        if values.requires_grad:
            return self.effects(values)
        last = self._last
        if last is None or not torch.equal(last[0], values):
            self._last = last = values.clone(), self.effects(values)
        return last[1]

    def _unit(self, modes_nm, optics: Optics, values: Tensor, when) -> Tensor:
        """Unit-flux images before the detector."""
        if not self.effects.at("time"):
            return self.psf.images(modes_nm, optics)
        modes, weights = self._in_time(modes_nm, values, when)
        return _mean(self.psf.images(modes, optics), weights)

    def _in_time(self, modes_nm: Tensor, values: Tensor, when):
        """Wavefronts at the nodes of the average over the recording, or at the time of each image."""
        if when is not None:
            return self.effects.modes_at(values, modes_nm, when), torch.ones(1, dtype=torch.float64)
        nodes, weights = np.polynomial.legendre.leggauss(TIMES)
        times = torch.as_tensor((nodes + 1) / 2).repeat(len(modes_nm))
        repeated = modes_nm.repeat_interleave(TIMES, dim=0)
        return self.effects.modes_at(values, repeated, times), torch.as_tensor(weights / 2)

    def _unit_and_jacobian(self, modes_nm, values: Tensor, when, held: bool, modal: bool):
        """Unit-flux images and derivatives with respect to modes and effects before the detector."""
        tangents = NO_TANGENTS if held else self.effects.tangents(values)
        modes, weights = modes_nm, torch.ones(1)
        if self.effects.at("time"):
            modes, weights = self._in_time(modes_nm, values, when)
        unit, jacobian = self.psf.images_and_jacobian(modes, self._optics(values), tangents, modal=modal)
        if len(weights) > 1:
            unit, jacobian = _mean(unit, weights), _mean(jacobian, weights)
        if held:
            return unit, jacobian
        moving = self.effects.free_at("time")
        whole = [self._whole_path(modes_nm, values, when, index)[:, None].to(unit.dtype) for index in moving]
        return unit, torch.cat([jacobian, *whole], dim=1)

    def _unit_and_pullback(self, modes_nm: Tensor):
        return self.psf.images_and_pullback(modes_nm, self.optics)

    def _whole_path(self, modes_nm, values: Tensor, when, index: int) -> Tensor:
        """Derivative of the unit-flux images along one effect parameter, the other effects held."""
        effects, piece = self.effects.held_but(values, index)
        alone = ImageModel(self.psf, effects)

        def images(v: Tensor) -> Tensor:
            return alone._unit(modes_nm, effects(v), v, when)

        return Directional(images, values[piece]).by(index - piece.start)


def _mean(per_time: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over the times of each image, from (images · times, ...) to (images, ...)."""
    parts = per_time.unflatten(0, (-1, len(weights)))
    return torch.tensordot(weights.to(parts), parts.movedim(1, 0), 1)
