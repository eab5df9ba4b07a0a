"""The pupil turns with the angles of a recording where the profile has a rule for it."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from astropy.io import fits
from helpers.optics_cases import vector

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.cube import read
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.model.recording_settings import psf_settings, require_one_setup
from irlos_pipe.stages.model.section import ModelConfig

KEYS = {
    "role": "psf",
    "spectrum": [{"wavelength_nm": 1600}],
    "diversity": {"zernike": {6: 50.0}},
    "pixel_scale_mas": 9.7,
    "detector": {"e_per_adu": 1.0, "read_noise_e": 1.0},
}


def turning(folder, **rule):
    """IRLOS whose pupil turns by a rule."""
    profile = yaml.safe_load((PROFILES / "irlos.yaml").read_text())
    profile["pupil"] = {"source": "a test", "status": "assumed", "turns": rule}
    path = folder / "turning.yaml"
    path.write_text(yaml.safe_dump(profile))
    return load_instrument(path)


def rotation_deg(folder, instrument, **angles):
    path = folder / "cube.fits"
    fits.PrimaryHDU(np.ones((2, 16, 16), np.float32)).writeto(path, overwrite=True)
    with fits.open(path) as hdus:
        raw = read(path, hdus, instrument)[0]
    return resolve(raw, AcquisitionKeys(**KEYS | angles), instrument).acquisition.pupil_rotation_deg


def test_the_pupil_of_irlos_stays_where_it_is(tmp_path):
    assert rotation_deg(tmp_path, load_instrument("irlos"), parallactic_angle_deg=30.0) == 0


def test_a_rule_turns_the_pupil_with_the_angles_of_the_recording(tmp_path):
    instrument = turning(tmp_path, offset_deg=45, parallactic=-1, derotator=2)
    angles = {"parallactic_angle_deg": 60.0, "derotator_angle_deg": 10.0}
    assert rotation_deg(tmp_path, instrument, **angles) == pytest.approx((45 - 60 + 20) % 360)
    assert rotation_deg(tmp_path, instrument, **angles, pupil_rotation_deg=-3.0) == -3


def test_an_angle_that_the_rule_needs_has_to_be_known(tmp_path):
    instrument = turning(tmp_path, parallactic=-1)
    with pytest.raises(InputDataError, match="turns with 'parallactic_angle_deg', which is not known"):
        rotation_deg(tmp_path, instrument)


def test_a_rule_with_an_unknown_angle_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"unknown key 'pupil\.turns\.paralactic'; did you mean"):
        turning(tmp_path, paralactic=-1)


def recording(name, angle_deg) -> Recording:
    acquisition = Acquisition(
        "psf", Detector(1.0, 1.0), ((1600.0, 1.0),), {}, 9.7, pupil_rotation_deg=angle_deg
    )
    return Recording(
        name=name,
        input="cube",
        acquisition=acquisition,
        images_e=np.ones((1, 32, 32), np.float32),
        used=np.ones(1, bool),
        reason=np.array([""]),
        good=np.ones((32, 32), bool),
        time_s=np.zeros(1),
        frame_counter=np.zeros(1, int),
        introduced_defocus_nm=np.zeros(1),
    )


def test_the_image_turns_with_the_pupil():
    instrument = load_instrument("irlos")
    images = [
        PsfModel(psf_settings(instrument, ModelConfig(), recording("a", angle)), (4,))
        .images(vector({}, (4,)))[0]
        .numpy()
        for angle in (0.0, 90.0)
    ]
    # both vanes lie on a diagonal: a quarter turn moves them to the other one
    assert np.abs(images[1] - np.rot90(images[0])).max() < 1e-5 * images[0].max()
    assert np.abs(images[1] - images[0]).max() > 1e-4 * images[0].max()


def test_recordings_with_pupils_at_different_angles_are_not_fitted_as_one():
    with pytest.raises(InputDataError, match="pupil_rotation_deg differ"):
        require_one_setup([recording("a", 0.0), recording("b", 5.0)])
