"""Structure function and long-exposure OTF of the AO residual.

Truth: adaptive quadrature with Bessel functions, dense sums, the closed form of von Kármán's structure
function, and a Monte Carlo average of HCIPy images through screens drawn by FFT (independent code).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import BAND, NARROW_H, RESIDUAL_LAW, halo_and_jitter, settings
from helpers.reference_psf import DIAMETER_M, reference
from scipy.integrate import quad
from scipy.special import gamma, j0, kv

from irlos_pipe.effects import EffectSet, SeeingHalo
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.structure_function import (
    InBandResidual,
    ResidualBand,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
    von_karman_nm2,
)

LENGTHS_M = np.array([0.05, 0.2, 0.5, 1.0, 2.0, 3.0, 4.0, 5.5, 7.0, 8.0])
R0_M = 0.2
VARIANCE_NM2 = 100.0**2


def in_band(bx_m, by_m, slope, *harmonics: float) -> np.ndarray:
    residual = InBandResidual(np.asarray(bx_m), np.asarray(by_m), BAND)
    return residual.structure_nm2(VARIANCE_NM2, torch.tensor(float(slope)), *harmonics).numpy()


@pytest.mark.parametrize("angle_deg", [0, 17, 90])
@pytest.mark.parametrize("slope", [-1, 0, 2, 11 / 3, 6])
def test_the_isotropic_residual_agrees_with_adaptive_quadrature(slope, angle_deg):
    def integral(weight):
        return quad(lambda f: f ** (1 - slope) * weight(f), BAND.low_per_m, BAND.cutoff_per_m, limit=500)[0]

    total = integral(lambda f: 1.0)
    exact = [2 * VARIANCE_NM2 * integral(lambda f, b=b: 1 - j0(2 * np.pi * f * b)) / total for b in LENGTHS_M]
    angle = np.deg2rad(angle_deg)
    ours = in_band(LENGTHS_M * np.cos(angle), LENGTHS_M * np.sin(angle), slope)
    assert ours == pytest.approx(np.array(exact), abs=1e-6 * VARIANCE_NM2)


@pytest.mark.parametrize(
    ("cos2", "sin2", "cos4", "sin4"),
    [(1, 0.5, 0, 0), (-2, 0, 0, 0), (0, 3, 0, 0), (0.8, -0.6, -0.5, 0.4), (3, -3, 2, 2)],
)
def test_a_stretched_residual_agrees_with_a_dense_sum(cos2, sin2, cos4, sin4):
    edges = np.geomspace(BAND.low_per_m, BAND.cutoff_per_m, 3001)
    f, width = np.sqrt(edges[1:] * edges[:-1])[:, None], np.diff(edges)[:, None]
    theta = (np.arange(720) + 0.5) * np.pi / 720
    power = f * width * f**-2 * np.exp(cos2 * np.cos(2 * theta) + sin2 * np.sin(2 * theta))
    power = power * np.exp(cos4 * np.cos(4 * theta) + sin4 * np.sin(4 * theta))
    bx, by = np.array([0.3, 1.0, -2.0, 4.0, 0.0]), np.array([0.1, 1.0, 3.0, -4.0, 7.5])
    fringes = [
        1 - np.cos(2 * np.pi * f * (x * np.cos(theta) + y * np.sin(theta)))
        for x, y in zip(bx, by, strict=True)
    ]
    exact = [2 * VARIANCE_NM2 * np.sum(power * fringe) / power.sum() for fringe in fringes]
    ours = in_band(bx, by, 2.0, cos2, sin2, cos4, sin4)
    assert ours == pytest.approx(np.array(exact), abs=2e-5 * VARIANCE_NM2)


def test_the_stretch_lies_along_its_angle():
    """Power at frequencies along x decorrelates along x first."""
    along_x, along_y = in_band([0.3, 0.0], [0.0, 0.3], 2.0, 1.0)
    assert along_x > 1.5 * along_y


def test_a_sum_of_ever_more_fringes_tends_to_twice_the_variance():
    distant = in_band(np.linspace(20, 25, 200), np.zeros(200), 0.0)
    assert distant.mean() == pytest.approx(2 * VARIANCE_NM2, rel=0.01)
    assert in_band([0.0], [0.0], 2.0) == pytest.approx([0.0], abs=1e-9)


def von_karman_structure_nm2(b_m: float, outer_scale_m: float) -> float:
    """Closed form, e.g. Conan 2000; D(inf) is twice the variance 0.0859 (L0/r0)^(5/3) rad²."""
    z = 2 * np.pi * b_m / outer_scale_m
    constant = 2 * 0.0229 * 6 * np.pi / 5 * (outer_scale_m / R0_M) ** (5 / 3)
    return constant * (1 - 2 ** (1 / 6) / gamma(5 / 6) * z ** (5 / 6) * kv(5 / 6, z)) * (500 / 2 / np.pi) ** 2


def test_the_uncorrected_turbulence_is_von_karman_less_its_corrected_part():
    def below_cutoff(b):
        return quad(
            lambda f: 4 * np.pi * f * von_karman_nm2(f, R0_M, 25.0) * (1 - j0(2 * np.pi * f * b)),
            0,
            BAND.cutoff_per_m,
            limit=1000,
        )[0]

    exact = [von_karman_structure_nm2(b, 25.0) - below_cutoff(b) for b in LENGTHS_M]
    ours = fitting_structure_nm2(LENGTHS_M, BAND, R0_M)
    assert ours == pytest.approx(np.array(exact), abs=2e-3 * 2 * fitting_variance_nm2(BAND, R0_M))


def test_the_variance_beyond_the_cut_off_has_its_closed_form():
    distant = ResidualBand(BAND.low_per_m, BAND.cutoff_per_m, outer_scale_m=1e6)
    kolmogorov = (
        0.0229 * 6 * np.pi / 5 * R0_M ** (-5 / 3) * BAND.cutoff_per_m ** (-5 / 3) * (500 / 2 / np.pi) ** 2
    )
    assert fitting_variance_nm2(distant, R0_M) == pytest.approx(kolmogorov, rel=1e-4)


def test_the_fitting_structure_saturates_at_twice_its_variance():
    assert fitting_structure_nm2(np.array([7.9]), BAND, R0_M)[0] == pytest.approx(
        2 * fitting_variance_nm2(BAND, R0_M), rel=0.01
    )


def test_a_seeing_of_one_arcsecond_is_a_fried_parameter_of_ten_centimetres():
    assert seeing_to_r0_m(1.0) == pytest.approx(0.1007, rel=1e-3)


def test_slopes_of_the_in_band_structure_are_differences():
    residual = InBandResidual(LENGTHS_M * 0.6, LENGTHS_M * -0.8, BAND)
    at = torch.tensor([VARIANCE_NM2, 2.3, 0.8, -0.6, -0.5, 0.4]).double()
    value, slopes = residual.structure_and_slopes(*at)
    assert value.numpy() == pytest.approx(residual.structure_nm2(*at).numpy(), rel=1e-12)
    for index, step in enumerate([1.0, *[1e-4] * 5]):
        move = torch.zeros(6).double()
        move[index] = step
        high, low = (residual.structure_nm2(*(at + s * move)).numpy() for s in (1, -1))
        assert slopes[index].numpy() == pytest.approx((high - low) / (2 * step), rel=1e-5, abs=1e-3)


# -- Monte Carlo -------------------------------------------------------------------------------

PERIOD_M, SCREENS, SAMPLES = 32.0, 400, 192


def screens_nm(variance_nm2: float, seed: int):
    """Residual screens on the pupil grid, drawn from a power law of slope 2 inside the band by FFT."""
    size = round(SAMPLES * PERIOD_M / DIAMETER_M)
    f = np.fft.fftfreq(size, PERIOD_M / size)
    radius = np.hypot(f[:, None], f[None])
    covered = np.clip((radius - BAND.low_per_m) * PERIOD_M + 0.5, 0, 1)  # part of each cell inside the band
    covered *= np.clip((BAND.cutoff_per_m - radius) * PERIOD_M + 0.5, 0, 1)
    power = covered * np.maximum(radius, 1e-9) ** -2
    amplitude = np.sqrt(power * variance_nm2 / power.sum())
    rng = np.random.default_rng(seed)
    for _ in range(SCREENS // 2):
        noise = rng.standard_normal((2, size, size))
        pair = np.fft.fft2(amplitude * (noise[0] + 1j * noise[1]))[:SAMPLES, :SAMPLES]
        yield from (pair.real, pair.imag)


@pytest.mark.slow
def test_the_long_exposure_is_the_mean_of_images_through_random_screens():
    wavelength_nm, window = NARROW_H[0][0], (32, 32)
    imager = reference(SAMPLES)
    drawn = np.array(
        [imager.image(screen.ravel(), wavelength_nm, window, 9.7) for screen in screens_nm(150.0**2, seed=11)]
    )
    model = PsfModel(settings(window, diversity={}), (4,), dtype=torch.float64)
    # Good seeing leaves next to nothing beyond the cut-off, as in the screens.
    good_seeing = SeeingHalo(BAND, RESIDUAL_LAW, 0.01)
    halo = EffectSet((good_seeing,), model.grids)
    values = torch.tensor([150.0**2, 2.0, 0.0, 0.0], dtype=torch.float64)
    ours = model.images(torch.zeros(1, 1), halo(values))[0].numpy()
    error = drawn.std(0, ddof=1) / np.sqrt(SCREENS)
    pull = (ours - drawn.mean(0)) / error
    assert np.abs(pull).max() < 5
    assert 0.5 < np.mean(pull**2) < 1.6
    without = model.images(torch.zeros(1, 1))[0].numpy()
    assert np.mean(((without - drawn.mean(0)) / error) ** 2) > 20


def test_turbulence_beyond_the_cut_off_adds_to_the_residual_inside():
    grids = PsfModel(settings(24), (4,)).grids
    grid = OtfGrid.of(grids.focal, grids.sampling)
    values = torch.tensor([100.0**2, 2.0, 0.0, 0.0], dtype=torch.float64)
    inside, both = (
        SeeingHalo(BAND, RESIDUAL_LAW, seeing).exponent(values, grid)[0] for seeing in (1e-4, 0.8)
    )
    lengths = np.hypot(grid.baseline_x_m[None], grid.baseline_y_m[:, None])
    beyond = 0.5 * (2 * np.pi / 1600) ** 2 * fitting_structure_nm2(lengths, BAND, seeing_to_r0_m(0.8))
    within = lengths < 8.0  # no two points of the pupil are further apart
    assert (both - inside).numpy()[within] == pytest.approx(beyond[within], abs=1e-5)


def test_the_otf_factors_lie_between_zero_and_one_and_start_at_one():
    model = PsfModel(settings(24), (4,), dtype=torch.float64)
    effects = halo_and_jitter(model)
    factor = effects(effects.starts).transfer
    assert factor[0, 0, 0] == pytest.approx(1, abs=1e-12)
    assert factor.min() > 0
    assert factor.max() <= 1 + 1e-12
