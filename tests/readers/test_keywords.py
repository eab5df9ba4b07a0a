"""Proposals for side-cars follow the conventions of those who write the keywords."""

import pytest
from astropy.io import fits

from irlos_pipe.readers.sidecar_template import proposals

ESO = {"HIERARCH ESO DET DIT": 0.2, "EXPTIME": 1.0}


@pytest.mark.parametrize(
    ("cards", "planes", "key", "value", "sure"),
    [
        ({"GAIN": 139, "EGAIN": 0.34}, 1, "detector.e_per_adu", 0.34, True),
        ({"GAIN": 139}, 1, "detector.e_per_adu", 139, False),
        ({"GAIN": (2.0, "[e-/ADU] gain")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "electrons per DN")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "[ADU/e-]")}, 1, "detector.e_per_adu", 2.0, False),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "detector.read_s", 0.1, True),
        ({"EXPTIME": 2.0, "COADDEXP": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"EXPTIME": 2.0, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 4}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "detector.coadds", 5, False),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "exposure_s", 1.0, False),
    ],
)
def test_a_proposal_has_the_meaning_of_its_author_or_is_doubtful(cards, planes, key, value, sure):
    header = fits.Header()
    for name, content in cards.items():
        header[name] = content
    proposed = proposals(header, planes)[key]
    assert proposed.value == pytest.approx(value) and (proposed.doubt == "") is sure


@pytest.mark.parametrize("ndit", [4, 5])
def test_the_exposures_of_a_cube_are_no_reads_of_a_frame(ndit):
    assert "detector.coadds" not in proposals(fits.Header(ESO | {"HIERARCH ESO DET NDIT": ndit}), 5)
