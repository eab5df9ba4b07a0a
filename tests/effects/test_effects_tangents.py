"""Derivatives with respect to effect parameters. Truth: finite differences of the predicted images."""

from functools import cache

import numpy as np
import pytest
import torch
from helpers.effect_cases import NOLLS, SPECTRUM, STRONG, WINDOW, conditions_of, made
from helpers.optics_cases import UT4, ncpa_nm, settings, vector

from irlos_pipe.conventions.pupil_drawing import turned, with_sizes
from irlos_pipe.effects import CATALOGUE, Effect, EffectSet, FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration, PupilSizes, RedrawnPupil
from irlos_pipe.estimate.score_test import frozen_effects
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.pupil import band_limited

WAVEFRONTS = torch.cat([vector(ncpa_nm(seed, NOLLS[-1], 100.0), NOLLS) for seed in (6, 7)])
FLUX, BACKGROUND = torch.tensor([1e6, 2e6]).double(), torch.tensor([20.0, 10.0]).double()
SMOOTH = sorted(set(STRONG) - {"pupil_misregistration", "pupil_geometry"})
IN_IMAGES = {name: kind for name, kind in CATALOGUE.items() if kind.plane != "ramp"}


@cache
def psf() -> PsfModel:
    return PsfModel(settings(WINDOW, SPECTRUM, pupil_samples=64), NOLLS, dtype=torch.float64)


def assert_differences(effects, starts, every=1, step=1e-4, least=0.1, tolerance=2e-5, plane="") -> None:
    """Compare derivatives by parameters of several effects with finite differences; starts may go by name."""
    whole = ImageModel(psf(), effects)
    if isinstance(starts, dict):
        starts = torch.cat([starts[effect.name] for effect in whole.effects.effects])
    values = starts
    jacobian = whole.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, values)[1][:, len(NOLLS) : -2]
    for index in whole.effects.free_at(plane) if plane else range(0, len(values), every):
        move = torch.zeros_like(values)
        move[index] = step * max(least, abs(float(values[index])))
        high, low = (whole.predict(WAVEFRONTS, FLUX, BACKGROUND, values + s * move) for s in (1, -1))
        theirs = ((high - low) / (2 * move[index])).numpy()
        assert jacobian[:, index].numpy() == pytest.approx(theirs, abs=tolerance * np.abs(theirs).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_derivatives_at_a_strong_level_and_by_modes_flux_and_background_are_finite_differences(name):
    effect, values = made(name)
    assert_differences([effect], values)
    whole = ImageModel(psf(), [effect])
    jacobian = whole.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, values)[1]
    step = torch.zeros(1, len(NOLLS)).double()
    step[0, 2] = 0.05
    at = [(WAVEFRONTS + s * step, FLUX * (1 + s * 1e-3), BACKGROUND + s) for s in (1, -1)]
    high, low = (whole.predict(*arguments, values) for arguments in at)
    total = 0.05 * jacobian[:, 2] + 1e-3 * FLUX[:, None, None] * jacobian[:, -2] + jacobian[:, -1]
    expected = ((high - low) / 2).numpy()
    assert total.numpy() == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_effects_in_the_pupil_are_differentiated_through_those_behind_them():
    (stop, turned), (bump, place) = made("pupil_misregistration"), made("phase_bump")
    (petals, steps), (amplitude, factors) = made("low_wind_effect"), made("amplitude_aberration")
    effects = [
        petals,
        FixedEffect(stop, turned),
        FixedEffect(bump, place, free=("x_m", "width_m")),
        amplitude,
    ]
    starts = {petals.name: steps, stop.name: turned[:0], bump.name: place[[1, 3]], amplitude.name: factors}
    assert_differences(effects, starts, every=3)


def test_effects_are_differentiated_in_the_star_and_in_its_ghosts():
    """Of two ghosts the second is held but for its focus, as after a calibration."""
    (ghost, first), (jitter, blur), (bump, place) = made("ghost"), made("tip_tilt_jitter"), made("phase_bump")
    second = FixedEffect(ghost, [0.1, -40.0, 70.0, -60.0, 0.0], free=("defocus_nm",))
    effects = [ghost, second, jitter, FixedEffect(bump, place, free=("nm",))]
    assert [len(one.parameters) for one in EffectSet(effects, psf().grids).effects] == [1, 5, 1, 1]
    assert_differences(effects, torch.cat([place[:1], first, torch.tensor([-60.0]), blur]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameter", "step"), [("distance_m", 0.01), ("direction_rad", 0.06), ("rotation_deg", 0.1)]
)
def test_petals_move_with_the_edges_of_the_drawing(parameter, step):
    """Truth: differences of the images, and of what they would be if petals stayed where they were told."""
    (stop, placed), (petals, steps) = made("pupil_misregistration"), made("low_wind_effect")
    whole = ImageModel(psf(), [FixedEffect(stop, placed, free=(parameter,)), FixedEffect(petals, steps)])
    at = placed[[one.name for one in stop.parameters].index(parameter)][None]
    high, low = (whole.predict(WAVEFRONTS, FLUX, BACKGROUND, at + s * step) for s in (1, -1))
    theirs = (high - low) / (2 * step)
    ours = whole.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, at)[1][:, len(NOLLS)]
    assert float((ours - theirs).norm() / theirs.norm()) < 0.04
    alone = ImageModel(psf(), [FixedEffect(stop, placed, free=(parameter,))])
    without = alone.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, at)[1][:, len(NOLLS)]
    assert float((without - theirs).norm() / theirs.norm()) > 0.2


def test_petals_and_segments_of_a_pupil_as_it_was_told_act_one_after_the_other():
    """Truth: their fields less that of the clear pupil, added."""
    grids, whole = psf().grids, []
    for names in (["low_wind_effect", "segment_piston"], ["low_wind_effect"], ["segment_piston"]):
        pairs = [made(name) for name in names]
        whole.append(EffectSet([FixedEffect(effect, values) for effect, values in pairs], grids)().pupil)
    clear = torch.as_tensor(grids.pupil.amplitude)
    both, petals, segments = (field.numpy() for field in whole)
    assert both == pytest.approx((petals + segments - clear.numpy()), abs=1e-12)


@pytest.mark.parametrize(("defocus_nm", "error"), [(0.0, 1e-6), (120.0, 0.05)])
def test_rough_derivatives_of_faint_ghosts_are_wrong_by_a_part_of_their_light(defocus_nm, error):
    """Truth: exact derivatives. A ghost as sharp as the star changes as the star does."""
    (ghost, _), (bump, place) = made("ghost"), made("phase_bump")
    effects = [
        FixedEffect(ghost, [0.03, 60.0, 40.0, defocus_nm, 0.0], free=("flux_ratio", "defocus_nm")),
        bump,
    ]
    rough = PsfModel(psf().settings, NOLLS, dtype=torch.float64, rough_derivatives=True)
    values = torch.cat([place, torch.tensor([0.03, defocus_nm], dtype=place.dtype)])
    (exact_e, exact), (images_e, ours) = (
        ImageModel(one, effects).predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, values)
        for one in (psf(), rough)
    )
    assert images_e.numpy() == pytest.approx(exact_e.numpy(), rel=1e-12)
    scale = exact.flatten(2).norm(dim=2)
    wrong = (ours - exact).flatten(2).norm(dim=2) / scale
    assert float(wrong.max()) < error
    own = len(NOLLS) + len(place)
    assert float(wrong[:, own : own + 2].max()) < 1e-6  # its own light and focus are differentiated exactly


def test_colours_and_pixels_are_differentiated_through_pupil_otf_and_copies():
    """Dispersion depends on the mean wavelength, a bump and a ghost's focus on each."""
    names = ["spectrum", "plate_scale", "atmospheric_dispersion", "ghost", "phase_bump"]
    effects, starts = zip(*map(made, names), strict=True)
    assert len(EffectSet(effects, psf().grids).free_at("sampling")) == 4
    by_name = dict(zip(names, starts, strict=True))
    assert_differences(effects, by_name, step=1e-5, least=1.0, tolerance=1e-6, plane="sampling")


def test_ghosts_are_there_in_the_pullback_and_among_frozen_effects():
    """Truth: the Jacobian, and the model itself."""
    ghost, values = made("ghost")
    whole = ImageModel(psf(), [FixedEffect(ghost, values)])
    images, jacobian = whole.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND)
    same, pullback = whole.predict_and_pullback(WAVEFRONTS, FLUX, BACKGROUND)
    factors = torch.linspace(-1, 1, images.numel()).double().view_as(images)
    expected = (jacobian * factors[:, None]).sum((2, 3))
    assert same.numpy() == pytest.approx(images.numpy(), rel=1e-9)
    assert pullback(factors).numpy() == pytest.approx(expected.numpy(), rel=1e-6)
    frozen = frozen_effects(EffectSet([ghost], psf().grids), values)
    theirs = ImageModel(psf(), frozen).predict(WAVEFRONTS, FLUX, BACKGROUND)
    assert theirs.numpy() == pytest.approx(images.numpy(), rel=1e-9)


def test_frozen_effects_have_the_wavelengths_and_pixels_that_some_of_them_make():
    """Truth: the same effects held, and their derivatives with one more."""
    pairs = [
        made(name) for name in ("plate_scale", "spectrum", "pupil_misregistration", "seeing_halo", "ghost")
    ]
    effects = EffectSet([effect for effect, _ in pairs], psf().grids)
    values = {effect.name: start for effect, start in pairs}
    at = torch.cat([values[effect.name] for effect in effects.effects])
    further, null = made("amplitude_aberration")
    both = [
        ImageModel(psf(), [*some, further]).predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, null)
        for some in (effects.held(at).effects, frozen_effects(effects, at))
    ]
    for held, frozen in zip(*both, strict=True):
        assert frozen.numpy() == pytest.approx(held.numpy(), rel=1e-6, abs=1e-9 * float(held.abs().max()))


def amplitude(
    distance_m: float, direction_rad: float, rotation_deg: float, hole_m: float, vane_m: float
) -> np.ndarray:
    """Band-limited amplitude from a drawing twice as fine as that of the effects."""
    stop_m = (distance_m * np.cos(direction_rad), distance_m * np.sin(direction_rad))
    geometry = with_sizes(turned(UT4, rotation_deg), obscuration_m=hole_m, vane_width_m=vane_m)
    return band_limited(geometry, 64, stop_m=stop_m, subsamples=32)


@pytest.mark.slow
@pytest.mark.parametrize(("index", "step"), [(0, 0.004), (1, 0.03), (2, 0.06), (3, 0.008), (4, 0.004)])
def test_derivatives_of_the_redrawn_pupil_are_good_to_a_few_percent(index, step):
    """The stop displaced, the vanes turned and wider, the hole larger: two effects, one drawing."""
    values, move = np.array([0.15, -0.6, 4.0, 1.3, 0.055]), np.zeros(5)
    move[index] = step
    expected = (amplitude(*(values + move)) - amplitude(*(values - move))) / (2 * step)
    grid, direction = psf().pupil_grid, torch.zeros(5).double()
    direction[index] = 1
    field = torch.zeros(1, *grid.amplitude.shape).double()
    effects = RedrawnPupil.together([PupilMisregistration(), PupilSizes(UT4)])

    def light(v: torch.Tensor) -> torch.Tensor:
        return effects.apply(v, field, grid)[0] / grid.light

    ours = Directional(light, torch.as_tensor(values)).along(direction).numpy()
    assert np.sqrt(np.mean((ours - expected) ** 2)) < 0.04 * np.sqrt(np.mean(expected**2))


def searched(name: str) -> list[Effect]:
    kind = IN_IMAGES[name]
    return kind.under(conditions_of(name), **kind.options_for(**STRONG[name])).candidates(WINDOW, 9.7)


# High apertures and lenslets mean something only where there are any: other tests look at them there.
ANYWHERE = set(IN_IMAGES) - {"high_aperture", "lenslet_images"}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ANYWHERE))
def test_every_effect_is_absent_at_its_null_values_and_shows_in_the_derivative_there(name):
    plain = ImageModel(psf()).predict(WAVEFRONTS, FLUX, BACKGROUND)
    with_halo_otf = 2e-5  # the plain path skips the OTF, whose grid ends elsewhere
    for effect in searched(name)[::7]:
        values = torch.tensor(effect.null_values, dtype=torch.float64)
        whole = ImageModel(psf(), [effect])
        absent, jacobian = whole.predict_and_jacobian(WAVEFRONTS, FLUX, BACKGROUND, values)
        assert absent.numpy() == pytest.approx(plain.numpy(), abs=with_halo_otf * float(plain.max()))
        if name not in ("ncpa_drift", "correlated_noise"):
            slopes = jacobian[:, len(NOLLS) : -2]
            assert all(p.null is not None for p in effect.parameters)
            assert torch.isfinite(slopes).all() and (slopes.abs().amax((0, 2, 3)) > 0).all()


@pytest.mark.parametrize("name", ["interpixel_crosstalk", "plate_scale", "vibration", "phase_bump"])
def test_beside_a_drift_derivatives_need_none_of_the_modes(name):
    (drift,), values = searched("ncpa_drift"), made(name)[1]
    drifting = FixedEffect(drift.base, np.full(len(drift.base.parameters), 20.0))
    whole = ImageModel(psf(), [drifting, made(name)[0]])
    at = WAVEFRONTS, FLUX, BACKGROUND, values
    every, alone = (whole.predict_and_jacobian(*at, modal=modal)[1] for modal in (True, False))
    assert torch.equal(alone, every[:, len(NOLLS) :])


@pytest.mark.slow
def test_a_shift_of_the_stop_darkens_the_rim_whichever_way_it_goes():
    """Analysis: to first order the light falls by the projected width of the rim and of the hole."""
    dark, grid = torch.zeros(1, 72, 72).double(), psf().pupil_grid
    for effect in PupilMisregistration().candidates(WINDOW, 9.7)[:-1]:
        change = Directional(lambda v, e=effect: e.apply(v, dark, grid)[0], torch.zeros(1).double()).by(0)
        lost_m = -float(change.sum()) / grid.light * (8.0 / 64) ** 2
        assert lost_m == pytest.approx(8.0 + 1.116, rel=0.03)  # less what the vanes cover
