"""Which recordings are calibrated together, and which are refused with one line."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.stages.calibrate.input import by_setup, require_joint
from irlos_pipe.stages.model.section import ModelConfig

NARROW, BROAD = ((1600.0, 1.0),), ((1215.0, 0.5), (1625.0, 0.5))
DETECTOR = Detector(1.0, 1.0)


def recording(name, spectrum=NARROW, diversity=170.0, source="mirror", focus_nm=(0.0, 0.0), **changes):
    acquisition = Acquisition("ncpa_calibration", DETECTOR, spectrum, {6: diversity}, 9.7, source, **changes)
    frames = len(focus_nm)
    return Recording(
        name,
        "calibration",
        np.ones((frames, 8, 8), np.float32),
        np.ones(frames, bool),
        np.full(frames, ""),
        np.ones((8, 8), bool),
        np.arange(frames, dtype=float),
        np.arange(frames),
        np.array(focus_nm),
        acquisition,
    )


CUBES = [recording("a"), recording("b", BROAD, -170.0, "lens"), recording("c")]


def context(*effects):
    return SimpleNamespace(model=ModelConfig(effects=("seeing_halo", *effects)))


def names(groups):
    return [[one.name for one in group] for group in groups]


def test_recordings_of_one_band_filter_diversity_and_focus_belong_together():
    assert names(by_setup(CUBES)) == [["a", "c"], ["b"]]
    named = [recording("d", filter="NH"), recording("e", focus_nm=(50.0, 50.0)), recording("f")]
    assert names(by_setup(named)) == [["d"], ["e"], ["f"]]


def test_a_filter_wavefront_says_of_which_filter_or_lens():
    groups = by_setup(CUBES)
    require_joint(context("chromatic_ncpa", {"filter_ncpa": {"of": "lens"}}), groups, "long_exposure")
    for entry in ("filter_ncpa", {"filter_ncpa": {"of": "lnes"}}):
        with pytest.raises(ConfigurationError, match=r"filter_ncpa: say of which .*'lens', 'mirror'"):
            require_joint(context(entry), groups, "long_exposure")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (recording("x", BROAD, pupil_rotation_deg=10.0), "x: rotation of the pupil of a are others"),
        (
            recording("x", BROAD, focus_nm=(0.0, 100.0)),
            "x: the introduced defocus changes from frame to frame",
        ),
    ],
)
def test_what_cannot_be_one_wavefront_is_refused(other, message):
    with pytest.raises(InputDataError, match=message):
        require_joint(context(), by_setup([replace(CUBES[0]), other]), "long_exposure")
