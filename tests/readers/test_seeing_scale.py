"""Seeing given by another monitor than SPARTA; truth is the linear relation written out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sparta_files import write_muse, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.seeing import SeeingScale
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.sidecar import AcquisitionKeys

IRLOS = load_instrument("irlos")
SCALED = replace(IRLOS, seeing_scales=IRLOS.seeing_scales | {"mass_dimm": SeeingScale(0.75, 0.02)})
NOTHING = AcquisitionKeys()


def seeing(folder: Path, recipe: AcquisitionKeys = NOTHING, header: dict | None = None, **keys):
    """Seeing that a recording is taken to have, and the warnings."""
    write_sidecar(folder / "acquisition.yaml", *(["seeing_arcsec"] if header else []), **keys)
    raw = RawRecording(
        name="rec",
        path=folder / "rec.fits",
        layout="fits_cube",
        adu=np.zeros((3, 8, 8)),
        frame_counter=np.arange(3),
        header=header or {},
    )
    resolved = resolve(raw, recipe, SCALED)
    return resolved.acquisition.seeing_arcsec, resolved.warnings


def test_translating_forth_and_back_changes_nothing_and_the_ratio_is_a_slope():
    scale, values = SeeingScale(0.8, 0.05), np.linspace(0.3, 2, 9)
    assert np.allclose(scale.from_sparta(scale.to_sparta(values)), values)
    assert scale.to_sparta(1.5) - scale.to_sparta(0.5) == pytest.approx(0.8)


def test_a_side_car_without_scale_is_on_that_of_sparta(tmp_path):
    assert seeing(tmp_path, seeing_arcsec=0.8) == (0.8, ())
    assert seeing(tmp_path, seeing_arcsec=0.8, seeing_scale="sparta") == (0.8, ())


def test_a_seeing_on_another_scale_is_translated_and_that_is_reported(tmp_path):
    value, warnings = seeing(tmp_path, seeing_arcsec=0.8, seeing_scale="mass_dimm")
    assert value == pytest.approx(0.62)
    assert warnings == ("rec: seeing of 0.80 arcsec by mass_dimm taken as 0.62 arcsec by SPARTA",)


def test_the_scale_in_the_recipe_wins(tmp_path):
    recipe = AcquisitionKeys(seeing_scale="sparta")
    assert seeing(tmp_path, recipe, seeing_arcsec=0.8, seeing_scale="mass_dimm")[0] == 0.8
    recipe = AcquisitionKeys(seeing_scale="mass_dimm")
    assert seeing(tmp_path, recipe, seeing_arcsec=0.8)[0] == pytest.approx(0.62)


def test_a_scale_holds_only_for_the_seeing_beside_it(tmp_path):
    header = {"seeing_arcsec": 0.8, "seeing_scale": "mass_dimm"}
    recipe = AcquisitionKeys(seeing_arcsec=0.9)
    assert seeing(tmp_path, header=header)[0] == pytest.approx(0.62)
    assert seeing(tmp_path, recipe, header=header)[0] == 0.9


def test_the_seeing_of_the_profile_is_never_translated(tmp_path):
    header = {"seeing_arcsec": -1.0, "seeing_scale": "mass_dimm"}  # not measured
    assert seeing(tmp_path, AcquisitionKeys(seeing_scale="mass_dimm"), header=header)[0] == 0.5


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"seeing_scale": "mass_dim"}, "seeing_scale = 'mass_dim' is not known .*; did you mean 'mass_dimm'"),
        ({"seeing_scale": "offset"}, r"seeing_arcsec = 0\.5 by offset would be -0\.1 by SPARTA"),
    ],
)
def test_what_makes_no_sense_is_reported_in_one_line(tmp_path, monkeypatch, keys, message):
    monkeypatch.setitem(SCALED.seeing_scales, "offset", SeeingScale(1.0, -0.6))
    with pytest.raises(InputDataError, match=message):
        seeing(tmp_path, seeing_arcsec=0.5, **keys)


def test_the_header_of_muse_has_the_monitors_seeing_and_its_table_that_of_sparta(tmp_path):
    cube, header = np.ones((2, 8, 8)), {"ESO TEL AMBI FWHM START": 0.7}
    (monitor,) = read_recordings(write_muse(tmp_path / "a.fits", cube, header=header), IRLOS)
    (sparta,) = read_recordings(write_muse(tmp_path / "b.fits", cube, header=header, seeing=[0.5]), IRLOS)
    (neither,) = read_recordings(write_muse(tmp_path / "c.fits", cube), IRLOS)
    assert (monitor.header["seeing_arcsec"], monitor.header["seeing_scale"]) == (0.7, "mass_dimm")
    assert (sparta.header["seeing_arcsec"], sparta.header["seeing_scale"]) == (0.5, "sparta")
    assert "seeing_scale" not in neither.header


def test_the_profile_says_that_its_relation_is_assumed_and_mass_dimm_is_the_more_pessimistic():
    scale = IRLOS.seeing_scales["mass_dimm"]
    assert IRLOS.facts["seeing_ratio_mass_dimm"][0].status == "assumed"
    assert 0 < scale.ratio < 1 and IRLOS.seeing_scales["sparta"] == SeeingScale()
