"""Settings that would take all memory, all time, or make no sense are refused before work begins.

Truth: the ranges that the documentation of the keys gives.
"""

import pytest

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.recordings.spec import load_spec

INPUTS = ("ramp=data_samples/ramp", "calibration=data_samples/calibration-sky")


@pytest.mark.parametrize(
    "setting",
    [
        "lift.modes=[4,100000]",
        "lift.modes=[4,0]",
        "sensitivity.mag_step=1e-9",
        "sensitivity.mag_step=1e-300",
        "sensitivity.realisations=1000000",
        "sensitivity.frames_per_offset=1000000",
        "sensitivity.modes=[[4,100000]]",
        "calibrate.highest_noll=100000",
        "calibrate.prior_scale=1e300",
        "model.cutoff_per_m=1e-300",
        "model.pupil_samples=1000000",
    ],
)
def test_a_setting_out_of_its_range_is_named(setting):
    with pytest.raises(ConfigurationError) as found:
        load_recipe("sensitivity", [setting], INPUTS)
    lines = str(found.value).splitlines()  # one for each kind of value that the key takes
    assert all(line.startswith(f"--set {setting.partition('=')[0]}: ") for line in lines)


def test_a_simulation_of_thousands_of_bands_is_refused():
    band = {"centre_nm": 1600.0, "half_width_nm": 20.0}
    with pytest.raises(ConfigurationError, match="bands"):
        load_spec("on_sky", [f"recordings.calibration.bands={[band] * 2000}"])
