"""Whether frames are those of a calibration. Truth: acquisitions and side-cars written out."""

from dataclasses import replace

import pytest
from helpers import focus_loop as made

from irlos_pipe.focus.calibration import optical_differences, stated_differences
from irlos_pipe.readers.sidecar import AcquisitionKeys

CALIBRATED = made.calibration().acquisition


def test_the_same_frames_agree_and_scales_of_weights_do_not_matter():
    same = replace(CALIBRATED, spectrum=((1625.0, 7.0), (2000.0, 0.0)), diversity={6: -170.2, 4: 0.0})
    assert optical_differences(same, CALIBRATED) == []
    assert stated_differences(AcquisitionKeys(), CALIBRATED) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spectrum": ((1215.0, 1.0),)}, "spectrum 1215 nm (1.00), not 1625 nm (1.00)"),
        ({"spectrum": ((1625.0, 1.0), (1215.0, 1.0))}, "1215+1625 nm (0.50+0.50)"),
        ({"pixel_scale_mas": 9.8}, "pixel_scale_mas 9.8, not 9.7"),
        ({"diversity": {6: 170.0}}, "diversity of Noll 6 170 nm, not -170"),
        ({"diversity": {6: -170.0, 5: 20.0}}, "diversity of Noll 5 20 nm, not 0"),
        ({"lenslets": 2}, "2x2 lenslets, not 1"),
    ],
)
def test_other_frames_are_told_by_what_differs(change, words):
    (line,) = optical_differences(replace(CALIBRATED, **change), CALIBRATED)
    assert words in line
