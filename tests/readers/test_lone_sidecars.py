"""A side-car without a recording is told, with what lies beside it; other YAML files are left alone."""

import shutil

import pytest
from astropy.io import fits
from conftest import invoke
from helpers.sparta_files import counts, star, write_recorder, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings, recording_files

IRLOS = load_instrument("irlos")
CUBE = counts(star(24, 24), 3)
RECIPE = "recipe: x\ninputs: {cube: in}\nstages: [ingest]\ningest: {acquisition: {role: psf}}\n"


@pytest.fixture
def ramp(tmp_path):
    for name in ("offset_0", "offset_1"):
        write_recorder(tmp_path / "in" / name, CUBE + (name == "offset_1"))
    return tmp_path / "in"


@pytest.mark.slow
@pytest.mark.parametrize("end", [".part", ".crdownload", None])
def test_a_recording_that_is_gone_or_unfinished_is_told_by_its_side_car(ramp, tmp_path, end):
    data = ramp / "offset_1" / "offset_1.fits"
    beside = "nothing lies beside it" if end is None else f"beside it: offset_1.fits{end}"
    data.unlink() if end is None else data.rename(f"{data}{end}")
    first, lone = recording_files([ramp])
    assert first.name == "offset_0.fits" and lone == ramp / "offset_1" / "acquisition.yaml"
    with pytest.raises(InputDataError, match=f"no recording that could be read belongs to it; {beside}"):
        read_recordings(lone, IRLOS)
    (tmp_path / "r.yaml").write_text(RECIPE)
    assert beside in invoke("validate", str(tmp_path / "r.yaml")).stderr
    run = invoke("run", str(tmp_path / "r.yaml"), "--output", str(tmp_path / "out"))
    assert run.exit_code == 5 and beside in run.stdout
    plan = invoke("night", str(ramp), "--output", str(tmp_path / "tree"), "--dry-run")
    assert beside in plan.stdout and "offset_0" in plan.stdout


def test_a_side_car_of_its_own_needs_a_file_of_its_name(tmp_path):
    fits.writeto(tmp_path / "a.fits.gz", CUBE)
    write_sidecar(tmp_path / "a.yaml")
    write_sidecar(tmp_path / "b.yaml")
    assert [path.name for path in recording_files([tmp_path])] == ["a.fits.gz", "b.yaml"]


def test_recipes_notes_and_a_side_car_above_the_recordings_are_left_alone(ramp):
    (ramp / "recipe.yaml").write_text(RECIPE)
    (ramp / "notes.yaml").write_text("seeing: 0.7\nroles: [psf]\n")
    (ramp / "torn.yaml").write_bytes(b"\xff\xfe{")
    shutil.copy(ramp / "offset_0" / "acquisition.yaml", ramp)
    assert len(recording_files([ramp])) == 2
