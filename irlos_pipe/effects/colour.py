"""Effects of colour: `atmospheric_dispersion`, `spectrum`, `plate_scale` and `anamorphism`.

Dispersion shifts the images of the wavelengths against each other; a wrong spectrum or pixel scale
changes λ, the photon weights, or the angle of a pixel, of which the image sees the ratio only: in a
narrow band a shifted centre and another scale are nearly one effect, and only Noll 4 and the halo, which
know λ by itself, distinguish them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public, Refraction, direction
from irlos_pipe.effects.planes import OtfEffect, SamplingEffect
from irlos_pipe.effects.public_values import components, size_and_angle
from irlos_pipe.optics.fourier_matrices import phasor
from irlos_pipe.optics.grids import OtfGrid, Sampling

# Fraction along either component; a detector tilted by 25° foreshortens one axis by as much.
LARGEST_STRAIN = 0.1
USUAL_STRAIN = 0.01  # a tilt of 8°; SPHERE's cylindrical mirrors make 0.6 %
UM = 1e-6
STRETCH = "stretch"  # parameter of a spectrum: how much wider it is
NOTHING_KNOWN = Refraction()
AIR_UM2 = 3.666e-9 / 4.39108e-7  # second coefficient of the refractivity of air over the first


class AtmosphericDispersion(OtfEffect):
    """Chromatic elongation that is left when nothing, or not enough, corrects the atmosphere's.

    Every wavelength is displaced along the direction to the zenith as the refractivity of air has it,
    ``1/λ² + 0.00835 µm²/λ⁴``; the OTF factor is ``exp(-2πi b·s/λ)``. The size is the slope at the mean
    wavelength: between J and H dispersion is 1.5 times as large in J and two thirds of it in H.
    """

    name = "atmospheric_dispersion"
    formula = (
        "T(b) = exp(−2πi b·s(λ) / λ), s ∝ 1/λ² + 0.00835 µm² / λ⁴; mas_per_um = |ds/dλ| at the mean "
        "wavelength"
    )
    belongs_to = "moment"
    mild = True
    instrumental = False
    public = (
        Public("mas_per_um", "mas/µm towards longer waves", 0.0, 5000.0),
        direction("angle_deg"),
    )
    sentence = "a chromatic elongation of {mas_per_um:.0f} mas/µm along {angle_deg:.0f}°"
    look_alike = "vibration, which is as long at every wavelength"
    reference = "Filippenko 1982, PASP 94, 715; refractivity: IAG 1999, as IAU SOFA's refco has it"

    def __init__(self, expected: Refraction = NOTHING_KNOWN):
        self.parameters = tuple(
            Parameter(name, "mas/µm", start, start, expected.sigma_mas_per_um, plausible=(-1500.0, 1500.0))
            for name, start in zip(("x_mas_per_um", "y_mas_per_um"), expected.mas_per_um, strict=True)
        )

    @classmethod
    def under(cls, conditions: Conditions) -> "AtmosphericDispersion":
        """See `Effect.under`: it starts at what altitude and air make of it, where these are known."""
        return cls(conditions.refraction)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        path_m = grid.path_m(values[0] * MAS, values[1] * MAS)
        return factor * phasor(-2 * np.pi * path_m * _displaced_um(grid) / grid.wavelengths_m)

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        turned = -2j * np.pi * _displaced_um(grid) / grid.wavelengths_m * self.apply(values, factor, grid)
        along = (MAS, 0.0), (0.0, MAS)
        return [turned * grid.path_m(*along[index]) for index in wanted]

    def describe(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(("mas_per_um", "angle_deg"), size_and_angle(*values), strict=True))

    def values_of(self, mas_per_um: float, angle_deg: float) -> list[float]:
        return components(mas_per_um, angle_deg)


def _displaced_um(grid: OtfGrid) -> Tensor:
    """How far refraction displaces each wavelength, over its slope at the mean, (wavelengths, 1, 1) [µm]."""
    mean_um = grid.mean_m / UM
    at, middle = (um**-2 + AIR_UM2 * um**-4 for um in (grid.wavelengths_m / UM, mean_um))
    return (at - middle) / (-2 * mean_um**-3 - 4 * AIR_UM2 * mean_um**-5)


class Spectrum(SamplingEffect):
    """The band differs from the assumed one in centre, width or colour.

    All wavelengths are shifted, stretched about the mean, and weighted by ``1 + slope (λ - λ_mean)``.

    Parameters: `mean_nm`, weighted mean of the assumed spectrum.
    """

    name = "spectrum"
    formula = "λ → wavelength_nm + width (λ − λ_mean); weight × (1 + slope (λ − λ_mean))"
    instrumental = False  # belongs to the filter
    fact = True
    public = (
        Public("wavelength_nm", "nm, true weighted mean, not its shift", 300.0, 5000.0, required=False),
        Public("slope", "1/µm, relative change of the weight", -5.0, 5.0, required=False),
        Public("width", "in units of the assumed one", 0.01, 10.0, required=False),
    )
    sentence = (
        "a spectrum about {wavelength_nm:.1f} nm instead of {told_nm:.1f} nm, {width:.2f} times as wide"
    )
    look_alike = "plate_scale in a narrow band; a second filter distinguishes them"
    reference = "Filter curve of the recording; Goodman 2005, Introduction to Fourier Optics, section 6.2"
    parameters = (
        Parameter("shift_nm", "nm", 0.0, 0.0, 50.0, -200.0, 200.0, plausible=(-100.0, 100.0)),
        Parameter("slope_per_um", "1/µm", 0.0, 0.0, 1.0, -3.0, 3.0, plausible=(-2.0, 2.0)),
        Parameter(STRETCH, "", 0.0, 0.0, 0.3, -0.9, 3.0, plausible=(-0.6, 1.0)),
    )

    def __init__(self, mean_nm: float):
        self.mean_nm = mean_nm

    @classmethod
    def under(cls, conditions: Conditions) -> "Spectrum":
        wavelengths_nm, weights = np.array(conditions.settings.spectrum, float).T
        return cls(float(np.average(wavelengths_nm, weights=weights)))

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: it belongs to its filter, so that another band shows nothing of it."""
        return self if here.settings.spectrum == first.settings.spectrum else Unseen(self)

    def apply(self, values: Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        mean = (nominal.wavelengths_m * nominal.weights).sum()
        distance = nominal.wavelengths_m - mean
        weights = sampling.weights * (1 + values[1] * distance / UM)
        moved = sampling.wavelengths_m + values[0] * NM + values[2] * distance
        return sampling._replace(wavelengths_m=moved, weights=weights / weights.sum())

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Mean wavelength before re-weighting, slope and width."""
        shift, slope, stretch = (float(v) for v in values)
        return {"wavelength_nm": self.mean_nm + shift, "slope": slope, "width": 1 + stretch}

    def phrase(self, public: Mapping[str, Any]) -> str:
        return super().phrase({**public, "told_nm": self.mean_nm})

    def values_of(
        self, wavelength_nm: float | None = None, slope: float = 0.0, width: float = 1.0
    ) -> list[float]:
        return [0.0 if wavelength_nm is None else wavelength_nm - self.mean_nm, slope, width - 1]


class Unseen(SamplingEffect):
    """An effect of another recording, of which this one shows nothing."""

    def __init__(self, effect: SamplingEffect):
        self.name, self.order, self.parameters = effect.name, effect.order, effect.parameters

    def apply(self, values: Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        return sampling


class PlateScale(SamplingEffect):
    """The pixels are larger on the sky than assumed, by a fraction.

    A lens away from its place, or another focal length: every angle that a pixel covers changes alike.

    Parameters: `told_mas`, the assumed scale.
    """

    name = "plate_scale"
    formula = "pixel scale × (1 + fraction)"
    fact = varies = True
    public = (Public("fraction", "of the assumed scale", -0.05, 0.05),)
    look_alike = "spectrum in a narrow band; two stars of known distance distinguish them"
    reference = "Goodman 2005, Introduction to Fourier Optics, section 5.2"
    parameters = (Parameter("fraction", "", 0.0, 0.0, 0.02, -0.05, 0.05, plausible=(-0.03, 0.03)),)

    def __init__(self, told_mas: float):
        self.told_mas = told_mas

    @classmethod
    def under(cls, conditions: Conditions) -> "PlateScale":
        return cls(conditions.settings.pixel_scale_mas)

    def shown(self, values: np.ndarray) -> dict[str, Any]:
        public = self.describe(values)
        return {"pixel_scale_mas": self.told_mas * (1 + public["fraction"])} | public

    def phrase(self, public: Mapping[str, Any]) -> str:
        corrected_mas = public.get("pixel_scale_mas", self.told_mas * (1 + public["fraction"]))
        return f"pixels of {corrected_mas:.3f} mas instead of {self.told_mas:.3f} mas"

    def apply(self, values: Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        return sampling._replace(pixel_scale_mas=sampling.pixel_scale_mas * (1 + values[0]))


class Anamorphism(SamplingEffect):
    """The image is stretched along one direction and compressed across it; areas stay.

    Tilted or cylindrical optics, gratings and a tilted detector do so. The size is the difference of the
    largest scale and the smallest over their mean, the angle that of the largest; the geometric mean of both
    is that of `plate_scale`.

    A pupil that is wider across the direction makes exactly the same diffraction pattern. It leaves the halo,
    the image motion and companions as they are, which an anamorphism stretches too: this alone tells the two
    apart, and where the halo may be elongated for itself, little of it.
    """

    name = "anamorphism"
    formula = (
        "I(a) → I(M⁻¹ a), M = (1 + E) / √(1 − ε²), E = ε (cos 2θ, sin 2θ; sin 2θ, −cos 2θ), ε = fraction / 2"
    )
    fact = True
    public = (
        Public("fraction", "largest less smallest scale of the image, over their mean", 0.0, 0.14),
        direction("angle_deg", "deg of the largest, from +x towards +y, 0 to 180"),
    )
    sentence = "an image {percent:.2f} % larger along {angle_deg:.0f}° than across"
    look_alike = "a pupil wider across that direction; two stars of known places distinguish them"
    reference = "Maire et al. 2016, SPIE 9908, 990834: 0.60 % in SPHERE"
    parameters = tuple(
        Parameter(name, "", 0.0, 0.0, USUAL_STRAIN, -LARGEST_STRAIN, LARGEST_STRAIN, 0.0, (-0.08, 0.08))
        for name in ("along_x", "along_diagonal")
    )

    def apply(self, values: Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        return sampling._replace(strain=sampling.strain + values / 2)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        along_x, along_diagonal = (float(v) for v in values)
        angle_deg = float(np.rad2deg(np.arctan2(along_diagonal, along_x)) / 2 % 180)
        return {"fraction": float(np.hypot(along_x, along_diagonal)), "angle_deg": angle_deg}

    def values_of(self, fraction: float, angle_deg: float) -> list[float]:
        twice = np.deg2rad(2 * angle_deg)
        return [fraction * float(np.cos(twice)), fraction * float(np.sin(twice))]

    def phrase(self, public: Mapping[str, Any]) -> str:
        return super().phrase({**public, "percent": 100 * public["fraction"]})
