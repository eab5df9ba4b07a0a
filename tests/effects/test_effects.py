"""OTF effects. Truth: averages of moved images by Gauss-Hermite quadrature, and analysis."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
import torch
from helpers.effect_cases import CONDITIONS
from helpers.lenslet_cases import lenslet_settings
from helpers.light_path_derivatives import assert_jacobian
from helpers.optics_cases import (
    BAND,
    DIVERSITY,
    FACILITY,
    J_AND_H,
    MAS_RAD,
    NCPA_LAW,
    PRIOR,
    RESIDUAL_LAW,
    SCALE_MAS,
    halo_and_jitter,
    ncpa_nm,
    settings,
    shift_nm,
    vector,
)
from helpers.simulated_scenes import NARROW_H, NCPA_NM, UT4, sky_frames

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.diagnosis.ramp import compare
from irlos_pipe.diagnosis.records import Options
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Conditions, EffectSet, FixedEffect, SeeingHalo, TipTiltJitter
from irlos_pipe.effects.base import kind_of, labels_of
from irlos_pipe.effects.lenslet_images import LensletImages
from irlos_pipe.effects.seeing_halo import AoCutoff
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions, LiftOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.defocus import defocus_nm_per_um, shaped_modes
from irlos_pipe.optics.grids import Optics, OtfGrid
from irlos_pipe.optics.lenslets import LensletArray, apart
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand, seeing_to_r0_m, von_karman_nm2
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects.wavefront import HighAperture as Simulated
from irlos_pipe.simulate.telescope import Telescope

NOLLS = tuple(range(2, 16))
SIGMA_MAS = 12.0


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings((36, 33), J_AND_H[1::3]), NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def wavefront() -> torch.Tensor:
    return vector(ncpa_nm(6, 15, 100.0), NOLLS)


def moved(model: PsfModel, wavefront: torch.Tensor, x_px: float, y_px: float) -> np.ndarray:
    tilted = wavefront.clone()
    tilted[0, :2] += torch.tensor([shift_nm(x_px), shift_nm(y_px)])
    return model.images(tilted)[0].numpy()


def jittered(model: PsfModel, wavefront: torch.Tensor, sigma_mas: float) -> np.ndarray:
    effects = EffectSet((TipTiltJitter(),), model.grids)
    return model.images(wavefront, effects(torch.tensor([sigma_mas**2], dtype=torch.float64)))[0].numpy()


def test_jitter_is_the_average_over_gaussian_image_motion(model, wavefront):
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()
    step = SIGMA_MAS / SCALE_MAS
    average = sum(
        wx * wy * moved(model, wavefront, step * x, step * y)
        for (x, wx), (y, wy) in itertools.product(zip(nodes, weights, strict=True), repeat=2)
    )
    assert jittered(model, wavefront, SIGMA_MAS) == pytest.approx(average, abs=1e-4 * average.max())


def test_an_asymmetric_kernel_is_convolved_not_correlated(model, wavefront):
    """A kernel with 30 % of its light at +3 columns, -2 rows leaves 30 % of the image there."""
    grid, wavelengths = model.grids.focal, torch.as_tensor(model.wavelengths_m)
    angle_x, angle_y = 3 * SCALE_MAS * MAS_RAD, -2 * SCALE_MAS * MAS_RAD
    path = torch.as_tensor(grid.baseline_x_m[None] * angle_x + grid.baseline_y_m[:, None] * angle_y)
    kernel = 0.7 + 0.3 * torch.exp(-2j * np.pi * path / wavelengths[:, None, None])
    image = model.images(wavefront, Optics(transfer=kernel))[0].numpy()
    expected = 0.7 * moved(model, wavefront, 0, 0) + 0.3 * moved(model, wavefront, 3, -2)
    assert image == pytest.approx(expected, abs=1e-4 * expected.max())
    mirrored = 0.7 * moved(model, wavefront, 0, 0) + 0.3 * moved(model, wavefront, -3, 2)
    assert np.abs(image - mirrored).max() > 0.1 * expected.max()


@pytest.mark.parametrize("measured", [True, False])
def test_a_residual_of_known_size_is_given_in_nm_or_as_a_part_of_what_is_expected(measured):
    halo = SeeingHalo(BAND, RESIDUAL_LAW, 0.5, measured)
    expected_nm = 104.27 * 0.5 + 58.6
    for values in (halo.values_of(wfe_nm=0.9 * expected_nm), halo.values_of(scale=0.9)):
        assert halo.describe(np.array(values))["wfe_nm"] == pytest.approx(0.9 * expected_nm)


def test_without_a_measured_seeing_the_whole_halo_grows_with_the_residual(model):
    grid = OtfGrid.of(model.grids.focal, model.grids.sampling)
    exponents = {}
    for measured in (True, False):
        halo = SeeingHalo(BAND, RESIDUAL_LAW, 0.5, measured)
        weak, strong = (
            halo.exponent(share * torch.tensor([80.0**2, *[0.0] * 5, 30.0**2]).double(), grid)
            for share in (1, 3)
        )
        exponents[measured] = weak.numpy(), strong.numpy()
    assert exponents[False][1] == pytest.approx(3 * exponents[False][0])
    unchanged = (3 * exponents[True][0] - exponents[True][1]) / 2
    assert unchanged.max() > 0.1 * exponents[True][0].max()


@pytest.mark.parametrize(("seeing_arcsec", "wfe_nm"), [(0.35, 95.1), (1.0, 162.9)])
def test_the_residual_to_start_from_follows_the_seeing_law(seeing_arcsec, wfe_nm):
    """104.27 nm/arcsec x seeing + 58.6 nm."""
    halo = SeeingHalo(BAND, RESIDUAL_LAW, seeing_arcsec)
    assert halo.describe([p.start for p in halo.parameters])["wfe_nm"] == pytest.approx(wfe_nm, abs=0.1)


def pinned(effects: EffectSet, values: torch.Tensor, free: tuple[str, ...]) -> EffectSet:
    pieces = effects.split(values)
    return EffectSet([FixedEffect(e, pieces[e.name], free) for e in effects.effects], effects.grids)


def test_pinned_effects_have_the_otf_of_the_values_they_are_held_at(model):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.3
    held = pinned(effects, values, ())
    assert held.parameters == ()
    assert torch.equal(held().transfer, effects(values).transfer)
    assert held.describe([]) == effects.describe(values)


def test_a_parameter_left_free_starts_at_its_value_and_acts_as_before(model):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.3
    partly = pinned(effects, values, ("slope", "variance_mas2"))
    assert [p.name for p in partly.parameters] == ["slope", "variance_mas2"]
    assert [p.start for p in partly.parameters] == [values[1], values[-1]]
    changed = values.clone()
    changed[1], changed[-1] = 2.9, 30.0
    own = torch.tensor([2.9, 30.0], dtype=torch.float64)
    assert torch.equal(partly(own).transfer, effects(changed).transfer)
    chosen = [effects.tangents(changed).transfer[i] for i in (1, -1)]
    for ours, theirs in zip(partly.tangents(own).transfer, chosen, strict=True):
        assert ours.numpy() == pytest.approx(theirs.numpy(), abs=1e-15)


# `high_aperture` in model, simulator and diagnosis of a ramp. Truth: closed forms, and what was put in.


SINE, DIAMETER_M = 0.85, 1.7
PIXEL_MAS = np.rad2deg(130e-9) * 3.6e6
OFFSETS_NM = np.linspace(-320.0, 320.0, 9)
STATIC = {6: 20.0, 7: -15.0, 11: 18.0}
SETTINGS = PsfSettings(
    PupilGeometry(DIAMETER_M, 0.0, ()),
    (33, 33),
    PIXEL_MAS,
    ((520.0, 1.0),),
    replace(CONDITIONS.settings.known, diversity_nm={}),
    pupil_samples=64,
    margin_mas=150.0,
    halo_margin_mas=300.0,
)


def test_the_simulator_makes_the_shape_of_the_model():
    grid = PsfModel(SETTINGS, (4,)).pupil_grid
    telescope = Telescope(PupilGeometry(DIAMETER_M, 0.0, ()), grid.u_m, np.ones_like(grid.amplitude))
    simulated = Simulated(SINE).defocus(telescope)
    inside = np.hypot(*np.meshgrid(grid.u_m, grid.u_m)) < 0.99 * DIAMETER_M / 2
    modelled = shaped_modes(grid, [4], SINE)[0]
    assert np.ptp((simulated - modelled)[inside]) < 2e-3 * np.ptp(modelled[inside])
    rho2 = np.add.outer(grid.u_m**2, grid.u_m**2)[inside] / (DIAMETER_M / 2) ** 2
    path_nm = 1e3 * (1 - np.sqrt(1 - SINE**2 * rho2))
    assert np.ptp(simulated[inside] * defocus_nm_per_um(SINE) - path_nm) < 1e-6 * np.ptp(path_nm)


@pytest.fixture(scope="module")
def ramps():
    """The same ramp, made with high aperture, fitted with the parabola and with the sphere."""
    high = replace(SETTINGS, focus_sine=SINE)
    nolls = (4, *STATIC)
    modes = np.column_stack([OFFSETS_NM, *(np.full(len(OFFSETS_NM), nm) for nm in STATIC.values())])
    mean = 4e5 * PsfModel(high, nolls, dtype=torch.float64).images(torch.as_tensor(modes)) + 5
    rng = np.random.default_rng(5)
    images = torch.as_tensor(rng.poisson(mean.numpy()) + rng.normal(0, 3, mean.shape))
    data = RampData(images, torch.ones(33, 33, dtype=torch.bool), NoiseModel(1.0, 9.0), OFFSETS_NM)
    start = torch.zeros(len(OFFSETS_NM), 3, dtype=torch.float64)
    start[:, 2] = torch.as_tensor(OFFSETS_NM)
    held_out = np.arange(len(OFFSETS_NM)) % 4 == 3
    fits = [
        fit_ramp(
            PsfModel(settings, (2, 3, 4), dtype=torch.float64),
            data,
            start,
            LiftOptions(),
            [HighOrderNcpa(list(STATIC))],
            seen=~held_out,
        )
        for settings in (SETTINGS, high)
    ]
    return SimpleNamespace(data=data, parabola=fits[0], sphere=fits[1], held_out=held_out)


@pytest.mark.slow
def test_lift_with_a_common_wavefront_finds_ramp_and_wavefront(ramps):
    found = ramps.sphere.effects["high_order_ncpa"]["zernike_nm"]
    assert {int(noll): nm for noll, nm in found.items()} == pytest.approx(STATIC, abs=1.0)
    assert ramps.sphere.defocus_nm == pytest.approx(OFFSETS_NM, abs=3.0)
    assert ramps.sphere.result.chi2_nu.numpy() == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
def test_held_out_images_want_the_sphere(ramps):
    found = compare(ramps.data, ramps.parabola, ramps.sphere, ramps.held_out)
    assert found.favours(5.0) and found.better == 1.0
    assert found.gap[1] < 0.7 * found.gap[0]
    assert not compare(ramps.data, ramps.sphere, ramps.parabola, ramps.held_out).favours(5.0)
    assert not compare(ramps.data, ramps.sphere, ramps.sphere, ramps.held_out).favours(5.0)


# `lenslet_images`. Truth: a tilt of the wavefront before one lenslet, and finite differences.


LENSLET_IMAGES_SETTINGS = lenslet_settings(20)
VALUES = {"x_mas": [20.0, 0.0, -5.0, 0.0], "y_mas": [0.0, -15.0, 5.0, 0.0], "flux": [0.0, 0.0, 0.2, -0.1]}
WAVEFRONT = torch.tensor([[10.0, -5.0, 60.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def psf() -> LensletArray:
    return LensletArray(LENSLET_IMAGES_SETTINGS, (2, 3, 4), dtype=torch.float64)


def test_an_image_moves_as_by_a_tilt_of_its_part_of_the_wavefront(psf):
    effect = LensletImages()
    values = torch.tensor(effect.values_of(**VALUES), dtype=torch.float64)
    images = apart(psf.images(WAVEFRONT, EffectSet([effect], psf.grids)(values))[0])
    for lenslet, image in enumerate(images):
        x_mas, y_mas, flux = (VALUES[key][lenslet] for key in ("x_mas", "y_mas", "flux"))
        tilts = torch.tensor([[tilt_nm(x_mas, 8.0), tilt_nm(y_mas, 8.0), 0.0]], dtype=torch.float64)
        expected = (1 + flux) * apart(psf.images(WAVEFRONT + tilts)[0])[lenslet]
        assert (image - expected).abs().max() < 1e-4 * expected.max()


def test_slopes_are_finite_differences(psf):
    values = torch.tensor(LensletImages().values_of(**VALUES), dtype=torch.float64)
    assert_jacobian(psf, EffectSet([LensletImages()], psf.grids), WAVEFRONT, values, [1e-3] * 12)


# A correction that ends elsewhere than told.
# Truth: quadrature of the definition by SciPy, finite differences, and recordings of the simulator, which
# shares no optics with the model.


LOW = ResidualBand(BAND.low_per_m, 0.5, BAND.outer_scale_m)
SEEING_ARCSEC = 0.6
LAW = ResidualLaw(225.0, 40.0)  # 175 nm at 0.6 arcsec, nearly all of it beyond so low a cut-off
EFFECT = AoCutoff(LOW, LAW, SEEING_ARCSEC)
WINDOW, FRAMES, HIGHEST_NOLL, TRUE_PER_M = (48, 48), 60, 30, 0.6
NOISE = NoiseModel(1.0, 1.0)


def grid():
    grids = PsfModel(settings(WINDOW, pupil_samples=64), (2, 3, 4), dtype=torch.float64).grids
    return OtfGrid.of(grids.focal, grids.sampling)


def factor(per_m: float) -> torch.Tensor:
    on = grid()
    one = torch.ones(1, *on.focal.baseline_y_m.shape, len(on.focal.baseline_x_m), dtype=torch.float64)
    return EFFECT.apply(torch.tensor([per_m]).double(), one, on)


@pytest.mark.parametrize("per_m", [0.4, 0.7])
def test_the_factor_is_that_of_the_structure_function_between_the_cut_offs(per_m):
    """Adaptive quadrature of 2 (1 - J0) over the rings between: turbulence, less what is left inside."""
    on, (row, column) = grid(), (3, 4)
    length = float(np.hypot(on.focal.baseline_x_m[column], on.focal.baseline_y_m[row]))
    in_band = (0.3 * LAW.wfe_nm(SEEING_ARCSEC)) ** 2 / (2 * np.pi * np.log(0.5 / LOW.low_per_m))

    def ring(f: float) -> float:
        turbulence_nm2 = von_karman_nm2(np.array(f), seeing_to_r0_m(SEEING_ARCSEC), LOW.outer_scale_m)
        power = float(turbulence_nm2) - in_band / f**2
        return float(4 * np.pi * f * power * (1 - scipy.special.j0(2 * np.pi * f * length)))

    structure_nm2 = scipy.integrate.quad(ring, per_m, 0.5)[0]
    expected = np.exp(-0.5 * (2 * np.pi / 1600.0) ** 2 * structure_nm2)
    assert float(factor(per_m)[0, row, column]) == pytest.approx(expected, rel=1e-4)


# -- recordings ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded() -> tuple[Frames, Conditions]:
    """Frames behind an AO that ends at 0.6 cycles per metre, and what is told of them: 0.5."""
    ncpa_nm = {noll: value for noll, value in NCPA_NM.items() if noll <= HIGHEST_NOLL}
    taken = {"window": WINDOW, "frames": FRAMES, "seed": (11, 3), "ncpa_nm": ncpa_nm, "throughput": 0.05}
    facility = replace(FACILITY, cutoff_per_m=TRUE_PER_M, residual_law=LAW)
    frames, _ = sky_frames(Sky(SEEING_ARCSEC), facility=facility, **taken)
    spectrum = tuple((band.centre_nm, 1.0) for band in NARROW_H)
    told = PsfSettings(UT4, WINDOW, 9.7, spectrum, KnownWavefront(DIVERSITY))
    conditions = Conditions(told, LOW, LAW, SEEING_ARCSEC, HIGHEST_NOLL, ncpa_law=NCPA_LAW)
    return frames, conditions


@pytest.mark.slow
def test_the_cut_off_of_a_recording_is_found_to_a_fifth_of_what_was_told_wrong(recorded):
    """As the residual inside is not quite as expected, the quoted error alone does not do."""
    frames, conditions = recorded
    effects = [SeeingHalo.under(conditions), AoCutoff.under(conditions)]
    options = CalibrationOptions("long_exposure", highest_noll=HIGHEST_NOLL, prior=PRIOR)
    found = calibrate(frames, conditions.settings, options, effects)
    assert found.effects["ao_cutoff"]["per_m"] == pytest.approx(TRUE_PER_M, abs=0.02)
    assert found.effects_sigma["ao_cutoff"]["per_m"] < 0.02


@pytest.mark.long
def test_a_cut_off_told_wrong_is_named_with_the_value_that_the_data_want(recorded):
    frames, conditions = recorded
    options = Options(HIGHEST_NOLL, held_out=0.25, most_names=1, sure=5.0)
    diagnosis = diagnose([Exposures(frames, conditions)], [SeeingHalo.under(conditions)], options)
    step = diagnosis.steps[0]
    assert step.name == "ao_cutoff"
    assert step.public["per_m"] == pytest.approx(TRUE_PER_M, abs=0.04)


def test_labels_count_the_effects_of_a_kind():
    names = ["companion", "plate_scale", "companion", "tip_tilt_jitter", "companion"]
    labels = labels_of([SimpleNamespace(name=name) for name in names])
    assert labels == ["companion", "plate_scale", "companion_2", "tip_tilt_jitter", "companion_3"]
    assert [kind_of(label) for label in labels] == names
