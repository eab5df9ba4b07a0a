"""Images with an effect. Truth: HCIPy on a pupil grid eight times finer than the model's, the effect put in
there by the definition of its parameters, or as a sum of HCIPy images (independent code)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.effect_cases import CONDITIONS, NOLLS, SPECTRUM, STRONG, WINDOW, affected, made
from helpers.optics_cases import DIVERSITY, MAS_RAD, SCALE_MAS, ncpa_nm, settings, vector
from helpers.reference_psf import reference

from irlos_pipe.effects import CATALOGUE, EffectSet, FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.wavefront import FilterNcpa
from irlos_pipe.optics.psf import PsfModel

STATIC_NM = ncpa_nm(6, NOLLS[-1], 100.0)
TOTAL_NM = {noll: STATIC_NM.get(noll, 0.0) + DIVERSITY.get(noll, 0.0) for noll in {*STATIC_NM, *DIVERSITY}}
TOLERANCE = 2e-4  # of the peak
TILT_NM_PER_MAS = MAS_RAD * 8.0 / 4 * 1e9


@cache
def model() -> PsfModel:
    return PsfModel(settings(WINDOW, SPECTRUM), NOLLS, dtype=torch.float64)


def ours(name: str) -> np.ndarray:
    return affected(model(), name, vector(STATIC_NM, NOLLS))[0].numpy()


def truth(extra_nm=None, *, transmission=None, spectrum=SPECTRUM, scale_mas=SCALE_MAS) -> np.ndarray:
    """HCIPy image with a further OPD, a function of the wavelength [nm] or a map, and another amplitude."""
    imager, weight = reference(), sum(w for _, w in spectrum)
    base = imager.opd_nm(TOTAL_NM)

    def opd(wavelength_nm: float) -> np.ndarray:
        extra = extra_nm(wavelength_nm) if callable(extra_nm) else extra_nm
        return base if extra is None else base + extra

    images = (imager.image(opd(nm), nm, WINDOW, scale_mas, transmission) * w / weight for nm, w in spectrum)
    return sum(images)


def tilt_nm(x_mas: float, y_mas: float) -> np.ndarray:
    """OPD that moves the image."""
    return reference().opd_nm({2: x_mas * TILT_NM_PER_MAS, 3: y_mas * TILT_NM_PER_MAS})


def xy_m(samples: int = 1024) -> tuple[np.ndarray, np.ndarray]:
    grid = reference(samples).grid
    return np.asarray(grid.x), np.asarray(grid.y)


def agree(image: np.ndarray, expected: np.ndarray) -> None:
    """Equal within the tolerance, and the effect is much larger than that."""
    assert np.abs(image - expected).max() <= TOLERANCE * expected.max()
    without = model().images(vector(STATIC_NM, NOLLS))[0].numpy()
    assert np.abs(without - expected).max() > 20 * TOLERANCE * expected.max()


def polar(size: float, angle_deg: float) -> tuple[float, float]:
    return size * np.cos(np.deg2rad(angle_deg)), size * np.sin(np.deg2rad(angle_deg))


@pytest.mark.slow
def test_a_sinusoidal_vibration_is_the_time_average_of_the_moving_image():
    x, y = polar(np.sqrt(2) * 14.0, 35.0)
    phases = np.cos((np.arange(8) + 0.5) * np.pi / 8)  # Gauss-Chebyshev: half a period
    agree(ours("vibration"), np.mean([truth(tilt_nm(s * x, s * y)) for s in phases], axis=0))


def refractivity(nm: float) -> float:
    """n − 1 of standard air times 10⁸, Edlén's formula as Filippenko 1982 has it."""
    per_um2 = (nm / 1e3) ** -2
    return 6432.8 + 2_949_810 / (146 - per_um2) + 25_540 / (41 - per_um2)


def test_dispersion_displaces_each_wavelength_by_the_refractivity_of_air_at_it():
    wavelengths, weights = np.array(SPECTRUM).T
    mean_nm = np.average(wavelengths, weights=weights)
    slope = (refractivity(mean_nm + 1) - refractivity(mean_nm - 1)) / 2

    def displacement_mas(nm: float) -> tuple[float, float]:
        distance_nm = (refractivity(nm) - refractivity(mean_nm)) / slope
        return polar(60.0 * distance_nm / 1e3, 120.0)

    agree(ours("atmospheric_dispersion"), truth(lambda nm: tilt_nm(*displacement_mas(nm))))


def test_chromatic_aberrations_grow_with_the_distance_from_the_mean_wavelength():
    wavelengths, weights = np.array(SPECTRUM).T
    mean_nm = np.average(wavelengths, weights=weights)
    slopes = reference().opd_nm(STRONG["chromatic_ncpa"]["zernike_nm_per_um"])
    agree(ours("chromatic_ncpa"), truth(lambda nm: slopes * (nm - mean_nm) / 1e3))


def test_the_wavefront_of_a_filter_acts_only_in_recordings_through_it():
    through = replace(CONDITIONS, elements=("J+H", "lens"))
    lens = FilterNcpa.under(through, nolls=(5, 8), of="lens")
    assert lens.seen_in(replace(CONDITIONS, elements=("NH", "lens")), through) is lens
    elsewhere = lens.seen_in(replace(CONDITIONS, elements=("J+H", "mirror")), through)
    values = torch.tensor([80.0, -60.0], dtype=torch.float64)
    unchanged = model().images(vector(STATIC_NM, NOLLS))[0]
    seen = model().images(vector(STATIC_NM, NOLLS), EffectSet([elsewhere], model().grids)(values))[0]
    assert seen.numpy() == pytest.approx(unchanged.numpy(), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "drawn"),
    [
        (["pupil_misregistration"], ((0.12, -0.08), 4.0)),
        (["pupil_geometry"], ((0, 0), 0.0, 1.4, 0.06)),
        (["pupil_misregistration", "pupil_geometry"], ((0.12, -0.08), 4.0, 1.4, 0.06)),
    ],
)
def test_a_pupil_of_other_sizes_displaced_or_turned_is_drawn_as_such(names, drawn):
    """A misplaced stop and turned vanes pass light where both do."""
    effects = EffectSet([FixedEffect(*made(name)) for name in names], model().grids)
    image = model().images(vector(STATIC_NM, NOLLS), effects())[0].numpy()
    agree(image, truth(transmission=reference().misregistered(*drawn)))


def test_an_amplitude_aberration_multiplies_the_field():
    factor = 1 + reference().opd_nm(STRONG["amplitude_aberration"]["zernike"])
    agree(ours("amplitude_aberration"), truth(transmission=reference().transmission * factor))


@pytest.mark.slow
def test_a_spot_is_a_disc_with_a_soft_edge():
    (x, y), spot = xy_m(), STRONG["pupil_spot"]
    distance2 = (x - spot["x_m"]) ** 2 + (y - spot["y_m"]) ** 2
    factor = 1 - spot["opacity"] * np.exp2(-((distance2 / spot["radius_m"] ** 2) ** 2))
    agree(ours("pupil_spot"), truth(transmission=reference().transmission * factor))


@pytest.mark.slow
def test_a_bump_is_a_gaussian_in_the_pupil():
    (x, y), bump = xy_m(), STRONG["phase_bump"]
    distance2 = (x - bump["x_m"]) ** 2 + (y - bump["y_m"]) ** 2
    agree(ours("phase_bump"), truth(bump["nm"] * np.exp(-distance2 / (2 * bump["width_m"] ** 2))))


def petal_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Petal at points outside the central hole, by the sides of the middle lines of the vanes of UT4.

    The vanes from (a, a) run to (R, 0) and (0, R), those from (-a, -a) to (-R, 0) and (0, -R).
    """
    a, reach = 0.370679, 4.2197

    def left_of(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
        return (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0

    first = left_of(a, a, reach, 0) & ~left_of(a, a, 0, reach)
    third = left_of(-a, -a, -reach, 0) & ~left_of(-a, -a, 0, -reach)
    return np.select([first, third, x < y], [0, 2, 1], 3)


@pytest.mark.slow
def test_petals_have_their_piston_tip_and_tilt():
    (x, y), effect = xy_m(), STRONG["low_wind_effect"]
    petal = petal_of(x, y)
    piston, tip, tilt = (np.array(effect[key])[petal] for key in ("piston_nm", "tip_nm", "tilt_nm"))
    agree(ours("low_wind_effect"), truth(piston + 2 / 4.0 * (tip * x + tilt * y)))


@pytest.mark.slow
def test_petals_turn_with_the_vanes_of_a_redrawn_pupil():
    stop, petals = made("pupil_misregistration"), made("low_wind_effect")
    effects = EffectSet([FixedEffect(effect, values) for effect, values in (petals, stop)], model().grids)
    image = model().images(vector(STATIC_NM, NOLLS), effects())[0].numpy()
    (x, y), angle, effect = xy_m(), np.deg2rad(4.0), STRONG["low_wind_effect"]
    petal = petal_of(np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x)
    piston, tip, tilt = (np.array(effect[key])[petal] for key in ("piston_nm", "tip_nm", "tilt_nm"))
    transmission = reference().misregistered((0.12, -0.08), 4.0)
    agree(image, truth(piston + 2 / 4.0 * (tip * x + tilt * y), transmission=transmission))
    lit = model().grids.pupil.amplitude > 0.9 * model().grids.pupil.light
    opd_nm = effects.opd_nm(torch.zeros(0))
    u, v = (axis * 4.0 for axis in model().grids.pupil.xy)
    own = petal_of(np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u)
    piston, tip, tilt = (np.array(effect[key])[own] for key in ("piston_nm", "tip_nm", "tilt_nm"))
    there = np.hypot(u, v) > 0.7
    expected = (piston + 2 / 4.0 * (tip * u + tilt * v))[lit & there]
    assert np.mean(np.abs(opd_nm.numpy()[lit & there] - expected) < 1e-6) > 0.995


@pytest.mark.slow
def test_a_companion_is_a_second_image_elsewhere():
    secondary = truth(tilt_nm(*polar(90.0, 300.0)))
    agree(ours("companion"), (truth() + 0.2 * secondary) / 1.2)


@pytest.mark.slow
def test_a_ghost_is_a_second_image_elsewhere_out_of_focus_and_blurred():
    """The blur is the mean over Gaussian positions by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    weights, (x, y) = weights / weights.sum(), polar(90.0, 120.0)
    ghost = sum(
        wx * wy * truth(tilt_nm(x + 10.0 * dx, y + 10.0 * dy) + reference().opd_nm({4: 90.0}))
        for dx, wx in zip(nodes, weights, strict=True)
        for dy, wy in zip(nodes, weights, strict=True)
    )
    agree(ours("ghost"), (truth() + 0.2 * ghost) / 1.2)


def test_ghosts_of_one_star_add_and_a_companion_has_its_ghosts_too():
    """Truth: sums of images with one effect each, of the definition."""
    at = vector(STATIC_NM, NOLLS)

    def image(*entries) -> np.ndarray:
        held = [
            FixedEffect(effect := CATALOGUE[name].under(CONDITIONS), effect.values_of(**public))
            for name, public in entries
        ]
        return model().images(at, EffectSet(held, model().grids)())[0].numpy()

    first, star = STRONG["ghost"], image(("tip_tilt_jitter", {"sigma_mas": 0.0}))
    second = first | {"flux_ratio": 0.1, "pa_deg": 20.0, "defocus_nm": -50.0}
    parts = [1.2 * image(("ghost", first)) - star, 1.1 * image(("ghost", second)) - star]
    assert image(("ghost", first), ("ghost", second)) == pytest.approx((star + sum(parts)) / 1.3, abs=1e-9)
    place = {"flux_ratio": 0.1, "sep_mas": 50.0, "pa_deg": 200.0}
    both = image(("companion", place), ("ghost", first))
    (x, y), (dx, dy) = polar(90.0, 120.0), polar(50.0, 200.0)
    sharp = {"sep_mas": np.hypot(x + dx, y + dy), "pa_deg": np.rad2deg(np.arctan2(y + dy, x + dx))}
    of_companion = 1.2 * image(("ghost", first | sharp)) - star
    expected = (1.1 * image(("companion", place)) + parts[0] + 0.1 * of_companion) / 1.1 / 1.2
    assert both == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_a_drift_blurs_the_mean_image_and_moves_single_ones():
    effect, values = made("ncpa_drift")
    whole = ImageModel(model(), [effect])
    change = reference().opd_nm({4: 120.0, 7: -80.0})
    one, none = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    at = vector(STATIC_NM, NOLLS), one, none, values
    nodes, weights = np.polynomial.legendre.leggauss(7)
    average = sum(w / 2 * truth(s / 2 * change) for s, w in zip(nodes, weights, strict=True))
    agree(whole.predict(*at)[0].numpy(), average)
    agree(whole.predict(*at, when=one)[0].numpy(), truth(0.5 * change))
