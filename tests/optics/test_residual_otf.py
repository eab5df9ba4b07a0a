"""Images that move with the coma of the AO residual. Truth: finite differences."""

import numpy as np
import pytest
import torch
from helpers.light_path_derivatives import assert_jacobian, assert_pullback, random_modes
from helpers.optics_cases import BAND, J_AND_H, NARROW_H, RESIDUAL_LAW, settings
from helpers.reference_psf import DIAMETER_M, reference
from helpers.residual_screens import kept, screens_nm
from scipy.integrate import quad
from scipy.special import gamma, j0, jv, kv

from irlos_pipe.effects import EffectSet, SeeingHalo
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.structure_function import (
    LOWEST,
    InBandResidual,
    Residual,
    ResidualBand,
    aliased_turbulence,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
    von_karman_nm2,
)

NOLLS = (2, 4, 5, 7, 8, 9, 22)
RESIDUAL = torch.tensor([120.0**2, 2.5, 0.6, -0.3, 0.2, 0.1, 60.0**2], dtype=torch.float64)
STEPS = (1.0, *[1e-4] * 5, 1.0)


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings(32, J_AND_H[::3], pupil_samples=64), NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def effects(model) -> EffectSet:
    return EffectSet((SeeingHalo(BAND, RESIDUAL_LAW, 0.8, measured=False),), model.grids)


@pytest.fixture(scope="module")
def modes() -> torch.Tensor:
    return random_modes(len(NOLLS))


def test_the_motion_is_a_part_of_the_image_that_none_of_the_other_factors_has(model, effects, modes):
    optics = effects(RESIDUAL)
    moving, still = (model.images(modes, one) for one in (optics, optics._replace(by_mode=())))
    assert float((moving - still).norm() / still.norm()) > 0.003


def test_derivatives_by_residual_and_modes_are_differences(model, effects, modes):
    assert_jacobian(model, effects, modes, RESIDUAL, STEPS)


def test_the_pullback_is_the_gradient_of_a_weighted_sum(model, effects, modes):
    assert_pullback(model, effects, modes, RESIDUAL)


# AO residual inside the correction band, without tip and tilt over the pupil.
# Truth: adaptive quadrature and dense sums of the spectrum; covariances of a random process on the points of
# a disc, from which tip and tilt are projected out; a Shack–Hartmann sensor simulated wave by wave; random
# points; and a Monte Carlo average of HCIPy images through screens drawn by FFT (independent code).


LENGTHS_M = np.array([0.05, 0.2, 0.5, 1.0, 2.0, 3.0, 4.0, 5.5, 7.0, 8.0])
VARIANCE_NM2 = 100.0**2
RADIUS_M, LOW_PER_M = DIAMETER_M / 2, LOWEST * BAND.low_per_m


def in_band(bx_m, by_m, slope, *more: float) -> Residual:
    residual = InBandResidual(np.asarray(bx_m), np.asarray(by_m), BAND)
    return Residual(*(one.numpy() for one in residual.at(VARIANCE_NM2, torch.tensor(float(slope)), *more)))


@pytest.mark.parametrize("angle_deg", [0, 17, 90])
@pytest.mark.parametrize("slope", [-1, 0, 2, 11 / 3, 6])
def test_the_isotropic_residual_agrees_with_adaptive_quadrature(slope, angle_deg):
    def integral(weight):
        return quad(lambda f: f ** (1 - slope) * weight(f), LOW_PER_M, BAND.cutoff_per_m, limit=500)[0]

    def without_tilt(f, b):
        z = 2 * np.pi * f * RADIUS_M
        return 2 * (1 - j0(2 * np.pi * f * b)) - 2 * (2 * jv(2, z) / z) ** 2 * (2 / RADIUS_M * b) ** 2

    total = integral(kept)
    exact = [VARIANCE_NM2 * integral(lambda f, b=b: without_tilt(f, b)) / total for b in LENGTHS_M]
    angle = np.deg2rad(angle_deg)
    ours = in_band(LENGTHS_M * np.cos(angle), LENGTHS_M * np.sin(angle), slope).structure
    assert ours == pytest.approx(np.array(exact), abs=2e-6 * VARIANCE_NM2)


@pytest.mark.parametrize(
    ("cos2", "sin2", "cos4", "sin4"),
    [(1, 0.5, 0, 0), (-2, 0, 0, 0), (0, 3, 0, 0), (0.8, -0.6, -0.5, 0.4), (3, -3, 2, 2)],
)
def test_a_stretched_residual_agrees_with_a_dense_sum(cos2, sin2, cos4, sin4):
    edges = np.geomspace(LOW_PER_M, BAND.cutoff_per_m, 3001)
    f, width = np.sqrt(edges[1:] * edges[:-1])[:, None], np.diff(edges)[:, None]
    theta = (np.arange(720) + 0.5) * np.pi / 720
    power = f * width * f**-2 * np.exp(cos2 * np.cos(2 * theta) + sin2 * np.sin(2 * theta))
    power = power * np.exp(cos4 * np.cos(4 * theta) + sin4 * np.sin(4 * theta))
    power *= VARIANCE_NM2 / np.sum(power * kept(f))
    z = 2 * np.pi * f * RADIUS_M
    tilt, coma = 2 * 2 * jv(2, z) / z * 2 / RADIUS_M, -np.sqrt(8) * 2 * jv(4, z) / z
    bx, by = np.array([0.3, 1.0, -2.0, 4.0, 0.0]), np.array([0.1, 1.0, 3.0, -4.0, 7.5])
    along = [x * np.cos(theta) + y * np.sin(theta) for x, y in zip(bx, by, strict=True)]
    exact = [np.sum(power * (2 - 2 * np.cos(2 * np.pi * f * b) - (tilt * b) ** 2)) for b in along]
    ours = in_band(bx, by, 2.0, cos2, sin2, cos4, sin4)
    assert ours.structure == pytest.approx(np.array(exact), abs=3e-5 * VARIANCE_NM2)
    squares = (np.cos(theta) ** 2, np.cos(theta) * np.sin(theta), np.sin(theta) ** 2)
    with_coma = [np.sum(power * tilt * coma * square) for square in squares]
    assert ours.tilt_with_coma == pytest.approx(np.array(with_coma), abs=1e-4 * np.abs(with_coma).max())


def test_a_process_without_tip_and_tilt_is_what_is_left_of_one_with_them():
    """Covariance matrix of the power law on a disc; the projection is a matrix, no polynomial's transform."""
    u = (np.arange(30) + 0.5) / 30 * DIAMETER_M - RADIUS_M
    x, y = (axis.ravel() for axis in np.meshgrid(u, u))
    x, y = (axis[np.hypot(x, y) < RADIUS_M] for axis in (x, y))
    edges = np.geomspace(LOW_PER_M, BAND.cutoff_per_m, 401)
    f = np.sqrt(edges[1:] * edges[:-1])
    power = np.diff(edges) * f**-2.0
    bx, by = x[:, None] - x, y[:, None] - y
    lengths, place = np.unique(np.round(np.hypot(bx, by), 6), return_inverse=True)
    structure = (2 * (1 - j0(2 * np.pi * np.outer(lengths, f))) @ power)[place].reshape(bx.shape)
    tilts = np.stack([np.ones_like(x), x, y])
    to_tilts = np.linalg.solve(tilts @ tilts.T, tilts)
    left = np.eye(len(x)) - tilts.T @ to_tilts
    covariance = left @ (-structure / 2) @ left.T
    scale = VARIANCE_NM2 / np.diag(covariance).mean()
    differences = scale * (np.diag(covariance)[:, None] + np.diag(covariance) - 2 * covariance)
    pairs = np.arange(0, bx.size, 997)
    ours = in_band(bx.ravel()[pairs], by.ravel()[pairs], 3.0)
    # The coma of the tilts, as a part of c, is what makes differences depend on the place.
    r2 = (x**2 + y**2) / RADIUS_M**2
    comas = np.sqrt(8) * np.stack([(3 * r2 - 2) * x, (3 * r2 - 2) * y]) / RADIUS_M
    xx, xy, yy = ours.tilt_with_coma
    c = np.array([[xx, xy], [xy, yy]]) @ comas
    place_dependent = 2 * sum(b * (one[:, None] - one) for b, one in zip((bx, by), c, strict=True))
    exact, stationary = differences.ravel()[pairs], ours.structure
    with_coma = stationary - place_dependent.ravel()[pairs]
    assert np.abs(exact - with_coma).mean() < 0.02 * 2 * VARIANCE_NM2  # c is not all coma
    assert np.abs(exact - stationary).mean() > 0.1 * 2 * VARIANCE_NM2


@pytest.mark.parametrize("turns", [(3, 1), (2, 5), (0, 4)])
def test_aliased_turbulence_is_what_a_simulated_sensor_takes_it_for(turns):
    """Waves beyond the cut-off through sub-apertures on a periodic square, reconstructed by least squares."""
    subapertures, fine = 16, 16
    pitch_m = 0.5 / BAND.cutoff_per_m
    size = subapertures * fine
    u = (np.arange(size) + 0.5) / size * subapertures
    fx, fy = np.array(turns) / subapertures  # of the wave that is seen, per sub-aperture
    total = 0.0
    for kx in range(-3, 4):
        for ky in range(-3, 4):
            if (kx, ky) == (0, 0):
                continue
            gx, gy = fx + kx, fy + ky
            wave = np.exp(2j * np.pi * (gx * u[None, :] + gy * u[:, None]))
            cells = wave.reshape(subapertures, fine, subapertures, fine).mean((1, 3))
            measured = [2j * np.pi * g * np.fft.fft2(cells)[turns[1], turns[0]] for g in (gx, gy)]
            seen = np.exp(2j * np.pi * (fx * u[None, :] + fy * u[:, None]))
            own = seen.reshape(subapertures, fine, subapertures, fine).mean((1, 3))
            expected = [2j * np.pi * f * np.fft.fft2(own)[turns[1], turns[0]] for f in (fx, fy)]
            fit = np.vdot(expected, measured) / np.vdot(expected, expected)
            total += abs(fit) ** 2 * np.hypot(gx, gy) ** (-11 / 3)
    ours = aliased_turbulence(np.array(fx / pitch_m), np.array(fy / pitch_m), BAND.cutoff_per_m)
    assert ours == pytest.approx(total * pitch_m ** (11 / 3), rel=0.02)


# -- Monte Carlo -------------------------------------------------------------------------------

SCREENS = 800
STEEP, RMS_NM = 3.0, 130.0
ABERRATED = {5: 60.0, 6: -170.0, 7: 40.0, 9: 50.0}


@pytest.mark.slow
def test_the_long_exposure_is_the_mean_of_images_through_random_screens():
    wavelength_nm, window = NARROW_H[0][0], (32, 32)
    imager = reference(96)
    still_nm = imager.opd_nm(ABERRATED)
    screens = screens_nm(imager, STEEP, RMS_NM, SCREENS, seed=11)
    drawn = np.array([imager.image(still_nm + one, wavelength_nm, window, 9.7) for one in screens])
    model = PsfModel(settings(window, diversity=ABERRATED), (4,), dtype=torch.float64)
    # Good seeing leaves next to nothing beyond the cut-off, as in the screens.
    good_seeing = SeeingHalo(BAND, RESIDUAL_LAW, 0.01)
    halo = EffectSet((good_seeing,), model.grids)
    values = torch.tensor([RMS_NM**2, STEEP, *[0.0] * 5], dtype=torch.float64)
    error = drawn.std(0, ddof=1) / np.sqrt(SCREENS)

    def mean_square_pull(optics) -> float:
        ours = model.images(torch.zeros(1, 1), optics)[0].numpy()
        return np.mean(((ours - drawn.mean(0)) / error) ** 2)

    optics = halo(values)
    assert 0.3 < mean_square_pull(optics) < 2
    assert mean_square_pull(optics._replace(by_mode=())) > 3 * mean_square_pull(optics)
    assert mean_square_pull(optics._replace(transfer=None, by_mode=())) > 20


# Turbulence beyond the correction band.
# Truth: adaptive quadrature with Bessel functions, and the closed form of von Kármán's structure function.


R0_M = 0.2


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


def test_turbulence_beyond_the_cut_off_adds_to_the_residual_inside():
    grids = PsfModel(settings(24), (4,)).grids
    grid = OtfGrid.of(grids.focal, grids.sampling)
    values = torch.tensor([100.0**2, 2.0, *[0.0] * 5], dtype=torch.float64)
    inside, both = (
        SeeingHalo(BAND, RESIDUAL_LAW, seeing).exponent(values, grid)[0] for seeing in (1e-4, 0.8)
    )
    lengths = np.hypot(grids.focal.baseline_x_m[None], grids.focal.baseline_y_m[:, None])
    beyond = 0.5 * (2 * np.pi / 1600) ** 2 * fitting_structure_nm2(lengths, BAND, seeing_to_r0_m(0.8))
    within = lengths < 8.0  # no two points of the pupil are further apart
    assert (both - inside).numpy()[within] == pytest.approx(beyond[within], abs=1e-5)
