"""The correction in the modes of a mirror, as a user runs it. Truth: the estimate of the same run, mixed."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import Result
from conftest import invoke
from helpers import sparta_files

from irlos_pipe.optics.wavefront import opd_maps_nm

RECIPE = """\
recipe: small
inputs: {cube: data/cube}
stages: [ingest, calibrate, correct]
model: {pupil_samples: 48}
calibrate: {input: cube, method: lift_slices, highest_noll: 6, max_iterations: 3}
correct: {input: cube}
"""
MIXTURE = np.array([[2.0, 1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, 3.0]])  # of Noll 4, 5, 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("mirror")
    adu = sparta_files.counts(sparta_files.star(16, 16), 8, seed=1)
    sparta_files.write_recorder(folder / "data" / "cube", adu)
    (folder / "small.yaml").write_text(RECIPE)
    write_modes(folder / "modes.fits", MIXTURE)
    return folder


def write_modes(path: Path, mixture: np.ndarray) -> None:
    maps_nm = opd_maps_nm((4, 5, 6), mixture, np.ones((40, 40), bool))
    fits.PrimaryHDU(maps_nm.astype(np.float32)).writeto(path, overwrite=True)


def corrected(folder: Path, modes: Path) -> Result:
    arguments = ["--output", str(folder / "run"), "--set", f"correct.mirror_modes={modes}"]
    return invoke("run", str(folder / "small.yaml"), *arguments)


def offsets(folder: Path) -> tuple[np.ndarray, dict]:
    results = json.loads((folder / "run" / "results.json").read_text())["stages"]
    with fits.open(folder / "run" / "mirror.fits") as hdus:
        assert np.array_equal(hdus[1].data["MODE"], np.arange(len(hdus[1].data)))
        assert (hdus[1].data["SIGMA"] > 0).all()
        return np.array(hdus[1].data["OFFSET"]), results


@pytest.mark.slow
def test_offsets_of_a_mirror_make_the_wavefront_of_the_modal_offsets(folder):
    result = corrected(folder, folder / "modes.fits")
    assert result.exit_code in (0, 4), result.stderr
    assert "3 modes of modes.fits" in result.stdout
    found, results = offsets(folder)
    expected = [results["correct"]["offset_nm"][noll] for noll in "456"]
    assert found @ MIXTURE == pytest.approx(expected, rel=1e-4)
    assert results["correct"]["mirror"]["offset"] == pytest.approx(found.tolist())
    assert results["correct"]["mirror"]["after_nm"] < 1e-3 * results["correct"]["mirror"]["before_nm"]
    rows = [line for line in (folder / "run" / "mirror.csv").read_text().splitlines() if line[0] != "#"]
    assert rows[0] == "mode,offset,sigma" and len(rows) == 4
    assert "Offsets of the mirror" in (folder / "run" / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((3, 40, 30), "an image of 3 × 40 × 30; modes are a cube of n × n maps"),
        (None, "bad.fits: cannot be read"),
        ((2, 40, 40), "its 2 modes are only 0 different shapes"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(folder, tmp_path, shape, message):
    if shape is None:
        (tmp_path / "bad.fits").write_text("no FITS")
    else:
        fits.PrimaryHDU(np.ones(shape)).writeto(tmp_path / "bad.fits")
    result = corrected(folder, tmp_path / "bad.fits")
    assert result.exit_code == 3 and message in result.stderr


def test_a_file_that_is_not_there_is_a_wrong_setting(folder, tmp_path):
    result = corrected(folder, tmp_path / "none.fits")
    assert result.exit_code == 2 and "none.fits" in result.stderr and "give a FITS cube" in result.stderr
