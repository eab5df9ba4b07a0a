"""`lenslet_images`: where the images of a 2x2 lenslet array lie, and how bright they are."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.units import MAS
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.optics.fourier_matrices import phasor
from irlos_pipe.optics.grids import OtfGrid

LENSLETS = 4
SIGMA_MAS, SIGMA_FLUX = 1.0, 0.1  # priors: how well images lie where they should, and how evenly light falls
WHICH = "lower left, lower right, upper left, upper right"


class LensletImages(OtfEffect):
    """Displacement of the image of every lenslet, and its light beyond its share.

    Tip, tilt, defocus and both astigmatisms imitate five patterns of the eight displacements; beside the
    shape of bright images only the prior tells them apart: its 1 mas per axis is 2.3 nm of defocus. The
    prior of the light is 10 %.
    """

    name = "lenslet_images"
    fact = True
    formula = "T_k(b) = (1 + f_k) exp(−2πi b·s_k/λ) for the image of lenslet k"
    public = (
        Public("x_mas", f"mas, {WHICH}", -1000.0, 1000.0, kind="parts"),
        Public("y_mas", "mas, in the same order", -1000.0, 1000.0, kind="parts"),
        Public("flux", "relative, in the same order", -0.9, 9.0, kind="parts"),
    )
    sentence = "images of the lenslets {rms_mas:.1f} mas RMS beside their places, and {percent:.0f} % uneven"
    look_alike = "the static wavefront: defocus moves all four images outwards"
    reference = "Hardy 1998, Adaptive Optics for Astronomical Telescopes, section 5.3.1"

    parameters = tuple(
        Parameter(f"{one.name}_{number}", unit, 0.0, 0.0, sigma, one.lower, one.upper)
        for one, (unit, sigma) in zip(public, 2 * [("mas", SIGMA_MAS)] + [("", SIGMA_FLUX)], strict=True)
        for number in range(1, LENSLETS + 1)
    )

    @classmethod
    def under(cls, conditions: Conditions) -> "LensletImages":
        if conditions.settings.lenslets == 1:
            raise ValueError("there are no lenslets before the sensor; leave it out")
        return cls()

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """See `OtfEffect.apply`; the factor gets a first axis of the lenslets."""
        x, y, flux = values.reshape(3, LENSLETS, 1, 1)
        path = grid.path_m(x * MAS, y * MAS)[:, None]
        return factor * (1 + flux[:, None]) * phasor(-2 * np.pi * path / grid.wavelengths_m)

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        whole, zero, one = self.apply(values, factor, grid), torch.zeros(()), torch.ones(())
        flux = values.reshape(3, LENSLETS)[2]
        found = []
        for kind, lenslet in (divmod(index, LENSLETS) for index in wanted):
            path = grid.path_m(*[(one if kind == axis else zero) * MAS for axis in (0, 1)])
            rate = 1 / (1 + flux[lenslet]) if kind == 2 else -2j * np.pi * path / grid.wavelengths_m
            slope = torch.zeros_like(whole)
            slope[lenslet] = whole[lenslet] * rate
            found.append(slope)
        return found

    def phrase(self, public: Mapping[str, Any]) -> str:
        places, flux = np.concatenate([public["x_mas"], public["y_mas"]]), np.array(public["flux"])
        sizes = {"rms_mas": np.sqrt(np.mean(places**2)), "percent": 100 * np.sqrt(np.mean(flux**2))}
        return super().phrase({**public, **sizes})

    def describe(self, values: np.ndarray) -> dict[str, list[float]]:
        table = np.asarray(values, float).reshape(3, LENSLETS)
        return {public.name: row.tolist() for public, row in zip(self.public, table, strict=True)}

    def values_of(self, **public: Sequence[float]) -> list[float]:
        wrong = [name for name, numbers in public.items() if len(numbers) != LENSLETS]
        if wrong:
            raise ValueError(
                f"{wrong[0]} has {len(public[wrong[0]])} values; give one per lenslet, {LENSLETS}"
            )
        return [float(number) for one in self.public for number in public[one.name]]
