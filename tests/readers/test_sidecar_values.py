"""Values of a side-car that are of the wrong kind."""

import pytest
from pydantic import ValidationError

from irlos_pipe.readers.sidecar import AcquisitionKeys


@pytest.mark.parametrize("key", ["pixel_scale_mas", "mag_j", "exposure_s"])
def test_a_truth_value_is_no_number(key):
    with pytest.raises(ValidationError, match="no number"):
        AcquisitionKeys.model_validate({key: True})


def test_truth_values_stay_where_they_belong():
    keys = AcquisitionKeys.model_validate({"detector": {"coadds_averaged": True}})
    assert keys.detector.coadds_averaged is True
