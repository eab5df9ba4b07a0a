"""Cubes whose numbers contradict what was told of them fail the quality check; roles must fit."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.effect_cases import CONDITIONS
from helpers.recordings import recording as made

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.effects import SeeingHalo, TipTiltJitter
from irlos_pipe.effects.declaration import Refraction
from irlos_pipe.estimate.calibration_errors import NominalChi2
from irlos_pipe.estimate.calibration_options import OneSetup, TwinCheck
from irlos_pipe.estimate.cube import Motion
from irlos_pipe.estimate.score_test import Mirrored
from irlos_pipe.frames.recording import Acquisition, Detector
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.product.product import Product
from irlos_pipe.readers.acquisition import altitude_deg
from irlos_pipe.stages.base import ModelConfig
from irlos_pipe.stages.calibrate.quality import Limits, checks_of
from irlos_pipe.stages.correct import _checks
from irlos_pipe.stages.model.effects import (
    pooled_images,
    psf_settings,
    refraction_mas,
    refraction_of,
    residual_band,
    seeing_arcsec,
    with_colour,
)
from irlos_pipe.stages.model.groups import by_setup, require_joint
from irlos_pipe.stages.model.untested import untested_by_cubes
from irlos_pipe.stages.sensitivity import announce

GOOD = {
    "frame_status": ["converged"],
    "chi2_nu": 0.40,
    "nominal": NominalChi2(0.37, 0.03),
    "window_resolutions": 15.0,
    "noise_ratio": 9.0,
    "kurtosis": 2.8,
    "errors_from": "frames",
    "frames_nm": [None] * 200,
    "twin": TwinCheck(7.5, 100.0, 330.0, 310.0, 60.0),
    "mirrored": Mirrored(0.05, 0.1),
    "motion": None,
    "mean_image_e": np.zeros((40, 48)),
    "effects": {"seeing_halo": {}},
    "setups": (),
    "fit": (),
    "adjusted": False,
    "introduced_accuracy": float("nan"),
    "nolls": range(2, 67),
    "sigma_nm": np.ones(65),
}


def _failed(limits: Limits | None = None, **changes) -> dict[str, str]:
    result = SimpleNamespace(**GOOD | changes)
    return {one.name: one.message for one in checks_of(limits or Limits(), result) if not one.passed}


def moved(most_px: float) -> Motion:
    return Motion(most_px * np.linspace(-1, 1, 20)[:, None] * [1.0, 0.5], 0.01)


def planes(wrong_nm: float) -> list[OneSetup]:
    """Planes 100 nm apart, of which one by itself wants another defocus."""
    return [OneSetup("a", nm, 1, 1.0, wrong_nm if nm == 100.0 else 3.0, 2.0) for nm in (-100.0, 0.0, 100.0)]


CHI2, TWIN, ERROR = "chi2 of the mean image", "twin solution", "error of the wavefront"
BENCH = {"nominal": NominalChi2(1.01, 0.04), "effects": {}}


@pytest.mark.parametrize(
    ("changes", "check", "said"),
    [
        *(({"mirrored": Mirrored(1.0, sigma)}, "orientation", "mirrored") for sigma in (0.01, 0.1, 0.2)),
        *(({"chi2_nu": chi2_nu}, CHI2, "nominal") for chi2_nu in (0.95, 2.7, 252.0)),
        ({"chi2_nu": 0.7, "fit": None}, CHI2, "nominal"),  # errors do not count what the model misfits
        ({"chi2_nu": 1.5} | BENCH, CHI2, "nominal"),
        ({"sigma_nm": np.full(65, 2.4)}, ERROR, "too large"),  # √27 · 2.4 nm in Noll 4–30
        ({"errors_from": "noise", "frames_nm": [None]}, "frames", "too few"),
        ({"chi2_nu": 0.14}, CHI2, "share their noise"),
        ({"noise_ratio": 0.01}, "noise as told", "e_per_adu"),
        ({"kurtosis": 1.05}, "frames of one kind", "two kinds"),
        ({"motion": moved(5.1)}, "motion of the star", "drifts, by 10.2 px"),
        ({"window_resolutions": 5.6}, "window", "outside"),
        ({"errors_from": "few_frames", "frames_nm": [None] * 3}, "frames", "too few"),
        ({"setups": planes(-90.0)}, "planes", "+100 nm by itself wants -90.0"),
        # though the RMS of the twin is larger
        *(({"twin": TwinCheck(0, 100, 120, 200, one)}, TWIN, "sign") for one in (-60.0, 0.0, 3.9)),
    ],
)
def test_a_cube_that_contradicts_what_was_told_fails_and_says_why(changes, check, said):
    assert said in _failed(**changes)[check]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mirrored": Mirrored(0.3, 0.1)},
        {"mirrored": Mirrored(1.0, 0.3)},  # mirrored or not within the errors
        {"mirrored": None},
        {"chi2_nu": 1.1} | BENCH,
        {"chi2_nu": 0.85},  # the AO residual has another shape: errors have a limit of their own
        {"sigma_nm": np.full(65, 2.3)},
        {"chi2_nu": 1.1, "sigma_nm": np.full(65, 2.4)} | BENCH,
        {"chi2_nu": 252.0, "limits": Limits(max_chi2_nu=1000.0)},  # a limit of the recipe
        {"kurtosis": float("nan")},
        {"motion": moved(4.9)},
        {"setups": planes(40.0)},
        {"errors_from": "noise", "frames_nm": [None] * 3},
    ],
)
def test_a_cube_within_its_errors_passes(changes):
    assert _failed(**changes) == {}


# Which recordings are calibrated together, and which are refused with one line.


NARROW, BROAD = ((1600.0, 1.0),), ((1215.0, 0.5), (1625.0, 0.5))
DETECTOR = Detector(1.0, 1.0)


def recording(name, spectrum=NARROW, diversity=170.0, source="mirror", focus_nm=(0.0, 0.0), **changes):
    told = {"spectrum": spectrum, "diversity": {6: diversity}, "diversity_source": source}
    return made(np.ones((len(focus_nm), 8, 8)), name, introduced_nm=focus_nm, **told, **changes)


CUBES = [recording("a"), recording("b", BROAD, -170.0, "lens"), recording("c")]


def context(*effects):
    return SimpleNamespace(model=ModelConfig(effects=("seeing_halo", *effects)))


def names(groups):
    return [[one.name for one in group] for group in groups]


def test_recordings_of_one_band_filter_diversity_and_focus_belong_together():
    assert names(by_setup(CUBES)) == [["a", "c"], ["b"]]
    named = [recording("d", filter="NH"), recording("e", focus_nm=(50.0, 50.0)), recording("f")]
    assert names(by_setup(named)) == [["d"], ["e"], ["f"]]


def test_frames_of_different_known_defocus_are_planes_the_sharpest_first():
    planes = by_setup([recording("a", focus_nm=(200.0, -100.0, 200.0)), recording("b", focus_nm=(200.0,))])
    assert names(planes) == [["a"], ["a", "b"]]
    assert [[one.introduced_defocus_nm.tolist() for one in plane] for plane in planes] == [
        [[-100.0]],
        [[200.0, 200.0], [200.0]],
    ]


def test_a_filter_wavefront_says_of_which_filter_or_lens():
    groups = by_setup(CUBES)
    require_joint(context("chromatic_ncpa", {"filter_ncpa": {"of": "lens"}}).model, groups, "long_exposure")
    for entry in ("filter_ncpa", {"filter_ncpa": {"of": "lnes"}}):
        with pytest.raises(ConfigurationError, match=r"filter_ncpa: say of which .*'lens', 'mirror'"):
            require_joint(context(entry).model, groups, "long_exposure")


@pytest.mark.parametrize("spectrum", [NARROW, BROAD])  # of the same set-up otherwise, and of another one
def test_what_cannot_be_one_wavefront_is_refused(spectrum):
    other = recording("x", spectrum, pupil_rotation_deg=10.0)
    with pytest.raises(InputDataError, match="x: rotation of the pupil of a are others"):
        require_joint(context().model, by_setup([CUBES[0], other]), "long_exposure")


# Which recordings have dispersion and the star's colour in their model.


SKY = [SeeingHalo.under(CONDITIONS), TipTiltJitter()]
COLOUR_NARROW = replace(
    CONDITIONS, settings=replace(CONDITIONS.settings, spectrum=((1585.0, 1.0), (1615.0, 1.0)))
)
DEFAULT = ModelConfig()


def names_of_colour(effects):
    return [effect.name for effect in effects]


def test_a_broad_band_on_sky_has_dispersion_as_expected_and_a_free_colour():
    known = replace(CONDITIONS, refraction=Refraction((120.0, -30.0), 17.0))
    *usual, dispersion, colour = with_colour(SKY, DEFAULT, known)
    assert names_of_colour(usual) == names_of_colour(SKY)
    assert [p.start for p in dispersion.parameters] == [120.0, -30.0]
    assert [p.prior_sigma for p in dispersion.parameters] == [17.0, 17.0]
    assert (colour.name, [p.name for p in colour.parameters]) == ("spectrum", ["slope_per_um"])


@pytest.mark.parametrize(
    ("effects", "model", "conditions"),
    [
        (SKY, DEFAULT, COLOUR_NARROW),
        (SKY[1:], DEFAULT, CONDITIONS),
        (SKY, ModelConfig(colour="listed"), CONDITIONS),
    ],
    ids=["a narrow band", "the bench", "switched off"],
)
def test_others_have_neither(effects, model, conditions):
    assert names_of_colour(with_colour(effects, model, conditions)) == names_of_colour(effects)


# Atmospheric dispersion from altitude and air. Truth: Filippenko's formula, written out here.


J_H = ((1215.0, 0.5), (1625.0, 0.5))
AIR = {"pressure_hpa": 743.0, "temperature_c": 11.5, "humidity_percent": 15.0}
UP = Acquisition("psf", Detector(1, 1), J_H, {}, 9.7, altitude_deg=45.0, zenith_angle_deg=60.0, **AIR)


def edlen(um: float, pressure_hpa: float, temperature_c: float) -> float:
    """n − 1 of dry air: Edlén 1953 as Filippenko 1982 has it."""
    s = um**-2
    standard = 1e-6 * (64.328 + 29498.1 / (146 - s) + 255.4 / (41 - s))
    p = pressure_hpa / 1.333224
    return (
        standard
        * p
        * (1 + (1.049 - 0.0157 * temperature_c) * 1e-6 * p)
        / 720.883
        / (1 + 0.003661 * temperature_c)
    )


@pytest.mark.parametrize("altitude", [80.0, 60.0, 45.0, 30.0])
def test_j_and_h_lie_as_far_apart_as_by_filippenko_s_formula(altitude):
    j, h = (refraction_mas(altitude, *AIR.values(), um) for um in (1.215, 1.625))
    change = edlen(1.215, 743.0, 11.5) - edlen(1.625, 743.0, 11.5)
    expected = change * np.tan(np.deg2rad(90 - altitude)) * np.rad2deg(1) * 3.6e6
    assert j - h == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize("unknown", ["altitude_deg", "zenith_angle_deg", "pressure_hpa"])
def test_what_is_not_known_leaves_dispersion_to_the_data(unknown):
    expected = refraction_of(replace(UP, **{unknown: None}), 1.42)
    assert expected.mas_per_um == (0.0, 0.0)
    assert expected.sigma_mas_per_um >= 300


def test_airmass_stands_in_for_the_altitude_and_must_not_contradict_it():
    assert altitude_deg(None, 2.0, "here") == pytest.approx(30.0)
    assert altitude_deg(30.0, 1.99, "here") == 30.0
    with pytest.raises(
        InputDataError, match=r"^here altitude_deg = 60 means an airmass of 1.15, but airmass = 2;"
    ):
        altitude_deg(60.0, 2.0, "here")


# What the stages refuse before a model is built. Truth: the geometry of the instrument.


IRLOS = load_instrument("irlos")


def test_the_residual_band_and_a_missing_seeing_are_those_of_the_instrument():
    facility = replace(IRLOS.facility, cutoff_per_m=9.0, outer_scale_m=30.0, typical_seeing_arcsec=0.7)
    own = replace(IRLOS, facility=facility)
    assert residual_band(own, ModelConfig()) == ResidualBand(1 / 8, 9.0, 30.0)
    assert residual_band(own, ModelConfig(cutoff_per_m=6.0)) == ResidualBand(1 / 8, 6.0, 30.0)
    assert seeing_arcsec(own, made(np.zeros((1, 64, 64))).acquisition) == 0.7


def test_a_window_wider_than_the_sampled_pupil_supports_is_an_error_of_the_recipe():
    with pytest.raises(ConfigurationError, match=r"model\.pupil_samples 48.*times as many"):
        psf_settings(IRLOS, ModelConfig(pupil_samples=48), made(np.zeros((1, 400, 400))))


# A Strehl ratio above what the AO residual leaves fails.
# Truth: the extended Maréchal approximation, exp(−(2πσ/λ)²), of the residual at the seeing that was told.


WAVELENGTH_NM, SEEING = 1600.0, 0.5
LIMIT = float(np.exp(-((2 * np.pi * (104.27 * SEEING + 58.6) / WAVELENGTH_NM) ** 2)))


@pytest.mark.parametrize(("strehl", "passed"), [(1.0, False), (LIMIT + 0.01, False), (LIMIT - 0.01, True)])
def test_a_strehl_ratio_above_what_the_residual_leaves_fails(strehl, passed):
    acquisition = SimpleNamespace(
        sources={"seeing_arcsec": "side-car"}, seeing_arcsec=SEEING, spectrum=((WAVELENGTH_NM, 1.0),)
    )
    ctx = SimpleNamespace(instrument=IRLOS, products={"calibrate": Product("calibrate", {}, {"effects": {}})})
    (check,) = _checks(ctx, SimpleNamespace(acquisition=acquisition), SimpleNamespace(strehl_after=strehl))
    assert check.passed == passed and check.high == pytest.approx(LIMIT, rel=1e-6)


# A sensitivity scan says what it will take before it begins. Truth: products of small numbers.


LOG = logging.getLogger("test_sensitivity_effort")


def test_a_scan_that_the_memory_cannot_hold_is_refused_before_it_begins(monkeypatch):
    monkeypatch.setattr("irlos_pipe.files.processes.available_bytes", lambda: 1e9)
    announce(20, (64, 64), 5, 6, 4, LOG)
    with pytest.raises(ConfigurationError, match=r"3.3 GB of memory.*sensitivity.realisations"):
        announce(20, (64, 64), 1000, 6, 4, LOG)


def test_frames_of_recordings_with_other_noise_have_the_mean_noise_whichever_comes_first():
    """Ten frames of 3 e- and thirty of 30 e-; truth: the variance over all the frames that were drawn."""
    rng = np.random.default_rng(4)
    both = [
        made(rng.normal(0, sigma_e, (frames, 32, 32)), detector=Detector(1.0, sigma_e))
        for sigma_e, frames in ((3.0, 10), (30.0, 30))
    ]
    for order in (both, both[::-1]):
        images_e, _, noise = pooled_images(order)
        assert noise.mean_variance_e2(0.0, 1) == pytest.approx(float(images_e.var()), rel=0.02)


def test_planes_do_not_tell_their_sign_and_zero_point():
    alone = untested_by_cubes({6: -170.0}, "", [0.0, 0.0])
    assert alone == untested_by_cubes({6: -170.0}) and alone[0].endswith("Noll 6 -170 nm")
    planes = untested_by_cubes({}, "", [0.0, -200.0, 200.0])
    assert planes[0].endswith("defoci from -200 to +200 nm") and planes[-1].startswith("zero point")
