"""Phase diversity by planes of known defocus. Truth: HCIPy images on a finer pupil, noise drawn here."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers.optics_cases import PRIOR, READ_NOISE, draw_frames, everything, ncpa_nm, settings
from helpers.reference_psf import reference

from irlos_pipe.effects import TipTiltJitter
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.calibration_options import CalibrationOptions, LiftOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp, start_from_defocus
from irlos_pipe.estimate.setups import Setup, SetupsFit, _part, calibrate_setups
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront
from irlos_pipe.stages.calibrate.quality import checks_of
from irlos_pipe.stages.calibrate.stage import Limits

pytestmark = pytest.mark.slow
PLANES_NM = (0.0, -150.0, 150.0, -300.0, 300.0)
WINDOW = (36, 36)
MODES = 15  # those that are drawn by the law; others follow, as in an instrument
OPTIONS = CalibrationOptions(prior=PRIOR)


@cache
def images(seed: int, beyond_nm: float, planes_nm=PLANES_NM) -> list[np.ndarray]:
    """Noise-free planes of NCPAs, with modes beyond those of the law of so many nm RMS each."""
    static_nm = ncpa_nm(seed, MODES, 60.0)
    drawn = np.random.default_rng(seed).normal(0, beyond_nm, 13)
    static_nm |= {noll: float(nm) for noll, nm in enumerate(drawn, start=MODES + 1)}
    return [reference(512).image(static_nm | {4: static_nm[4] + nm}, 1600.0, WINDOW, 9.7) for nm in planes_nm]


def planes(seed: int, flux_e: float, frames: int = 1, beyond_nm: float = 0.0, declared_nm=PLANES_NM):
    """Set-ups of one recording whose planes are declared at some defoci."""
    found = []
    for number, (image, nm) in enumerate(zip(images(seed, beyond_nm), declared_nm, strict=True)):
        drawn = draw_frames(flux_e * image, frames, 10 * seed + number)
        under = settings(WINDOW, pupil_samples=64, diversity={}, known=KnownWavefront({}, {4: nm}))
        found.append(Setup(Frames(drawn, everything(drawn), READ_NOISE), under, names=("bench",)))
    return found


def errors_nm(seed: int, found) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the first modes from Noll 4 on, and the same over the quoted ones."""
    error = found.zernike_nm[2 : MODES - 1] - list(ncpa_nm(seed, MODES, 60.0).values())[2:]
    return error, error / found.sigma_nm[2 : MODES - 1]


def failed(found) -> dict[str, str]:
    return {one.name: one.message for one in checks_of(Limits(), found) if not one.passed}


@pytest.mark.parametrize(
    ("flux_e", "frames", "beyond_nm", "off", "largest_nm"),
    [(1e5, 1, 0.0, 0.0, 3.0), (1e6, 1, 8.0, 0.05, 3.0), (1e5, 20, 8.0, 0.0, 1.5)],
)
def test_ncpas_from_planes_are_within_their_errors(flux_e, frames, beyond_nm, off, largest_nm):
    """`off` is the part by which the declared defoci are wrong, RMS."""
    pulls, accuracies = [], []
    for seed in range(4):
        wrong = 1 + off * np.random.default_rng(seed).standard_normal(len(PLANES_NM))
        declared_nm = tuple(PLANES_NM * wrong)
        found = calibrate_setups(planes(seed, flux_e, frames, beyond_nm, declared_nm), OPTIONS)
        accuracies.append(found.introduced_accuracy)
        error, pull = errors_nm(seed, found)
        pulls.append(pull)
        assert np.linalg.norm(error) < largest_nm
        assert found.twin.preferred == "solution" and failed(found) == {}
        assert len(found.frames_nm) == frames * len(PLANES_NM)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert np.median(accuracies) == pytest.approx(off, rel=0.5, abs=0.003)


def test_faint_planes_leave_no_mode_less_known_than_it_was_before():
    """The error of a mode that the images do not show is that of the prior."""
    law = replace(PRIOR, scale=1.0)
    found = calibrate_setups(planes(1, 300.0), replace(OPTIONS, prior=law))
    ratio = found.sigma_nm[2:] / law.sigma_nm(found.nolls)[2:].numpy()
    assert 0.9 < ratio.max() < 1.05


def test_a_plane_of_the_wrong_sign_does_not_pass_unnoticed():
    declared_nm = (0.0, -150.0, 150.0, -300.0, -320.0)
    found = calibrate_setups(planes(3, 1e6, declared_nm=declared_nm), OPTIONS)
    assert "-320 nm" in failed(found)["planes"]
    assert found.setups[4].focus_nm == pytest.approx(620.0, abs=60.0)


def test_planes_of_one_recording_share_star_and_sky_and_nothing_of_their_frames():
    own = (TipTiltJitter(),)
    some = [replace(one, own=own) for one in planes(0, 1e5)]
    sizes = {}
    for names in (("bench",), ()):
        these = [replace(one, names=names) for one in some]
        sizes[names] = SetupsFit(these, [_part(one, OPTIONS, "cpu") for one in these]).size
    count = len(PLANES_NM)
    errors_of_steps = count - 1
    assert sizes[("bench",)] == 63 + 4 * count + 1 + errors_of_steps  # Noll 4 to 66
    assert sizes[()] == sizes[("bench",)] + count - 1


def test_common_modes_of_a_ramp_are_within_the_errors_that_are_quoted():
    modes, pulls = tuple(range(5, MODES + 1)), []
    for seed in range(4):
        frames = [one.frames for one in planes(seed, 1e5)]
        data = RampData(
            torch.cat([one.images_e for one in frames]), frames[0].good, READ_NOISE, np.array(PLANES_NM)
        )
        model = PsfModel(settings(WINDOW, diversity={}).for_single_frames(), (2, 3, 4))
        start = start_from_defocus(model, data, data.introduced_nm)
        found = fit_ramp(model, data, start, LiftOptions(), [HighOrderNcpa(modes)])
        values, sigma = (one["high_order_ncpa"]["zernike_nm"] for one in (found.effects, found.sigma))
        truth = ncpa_nm(seed, MODES, 60.0)
        pulls += [(values[key] - truth[int(key)]) / sigma[key] for key in values]
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4
