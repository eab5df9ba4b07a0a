"""The simulator of the committed data samples. Truth: angles of tilts, the seeing law, another simulator."""

import ast
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.io import fits

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples"
BENCH = SAMPLES.parents[1] / "shared" / "samples"


def cube_adu(folder: Path) -> np.ndarray:
    table = fits.getdata(folder / f"{folder.name}.fits", "IRPixelFrame")
    return table["Pixels"].reshape(-1, table["WindowSizeY"][0], table["WindowSizeX"][0])


def dark_adu(folder: Path) -> np.ndarray:
    return fits.getdata(folder / "IRAcq.DET1.DARK.fits")


def side_car(folder: Path) -> dict:
    return yaml.safe_load((folder / "acquisition.yaml").read_text())


def signal_e(folder: Path) -> np.ndarray:
    return (cube_adu(folder) - dark_adu(folder).astype(float)) * side_car(folder)["detector"]["e_per_adu"]


def test_the_simulator_is_independent_of_the_package():
    scripts = list(SAMPLES.rglob("*.py"))
    assert SAMPLES / "make_samples.py" in scripts
    for script in scripts:
        for node in ast.walk(ast.parse(script.read_text())):
            names = [alias.name for alias in getattr(node, "names", [])] + [getattr(node, "module", "") or ""]
            assert not any(name.startswith("irlos_pipe") for name in names if name), script


@pytest.fixture(scope="module")
def telescope():
    pytest.importorskip("hcipy", reason="the simulator needs HCIPy, a development dependency")
    sys.path.insert(0, str(SAMPLES))
    from simulator.telescope import build_telescope

    yield build_telescope()
    sys.path.remove(str(SAMPLES))


@pytest.mark.slow
@pytest.mark.parametrize(("noll", "axis"), [(2, 1), (3, 0)], ids=["x-tilt to columns", "y-tilt to rows"])
def test_a_positive_tilt_moves_the_simulated_image_to_larger_indices(telescope, noll, axis):
    from simulator.imaging import Imager

    pixels = 5
    tilt_nm = np.deg2rad(pixels * 9.7 / 3.6e6) * 8.0 / 4 * 1e9  # RMS of a tilt: angle * D / 4
    image = Imager(telescope, [1600.0], [1.0], 63, 9.7).image(telescope.opd_nm({noll: tilt_nm}))
    expected = [31, 31]
    expected[axis] += pixels
    assert np.unravel_index(image.argmax(), image.shape) == tuple(expected)
    assert 0.9 < image.sum() < 1


@pytest.mark.slow
def test_the_simulated_residual_follows_the_seeing_law(telescope):
    from simulator.atmosphere import ResidualScreens

    screens = ResidualScreens(telescope, seeing_arcsec=0.5, step_s=0.05, rng=np.random.default_rng(3))
    weight = telescope.transmission / telescope.transmission.sum()
    drawn_nm = [screens.next_nm() for _ in range(150)]
    assert np.sqrt(np.mean([np.sum(weight * opd**2) for opd in drawn_nm])) == pytest.approx(110.7, rel=0.05)
    assert np.abs([np.sum(weight * opd * telescope.modes[1]) for opd in drawn_nm]).max() < 0.01


@pytest.mark.slow
@pytest.mark.skipif(not BENCH.exists(), reason="shared samples are not beside the checkout")
def test_the_simulator_reproduces_an_independent_bench_recording_within_its_noise(telescope):
    from simulator.imaging import Imager

    folder = BENCH / "calibration-bench"
    known = json.loads((BENCH / "truth" / "calibration-bench.json").read_text())["ncpa_nm"]
    wavefront_nm = {int(noll): value for noll, value in known.items()}
    wavefront_nm[6] -= 170.0
    shape = Imager(telescope, [1600.0], [1.0], 64, 9.7).image(telescope.opd_nm(wavefront_nm)).ravel()
    mean_e = signal_e(folder).mean(axis=0).ravel()
    background_e = 0.5 * dark_adu(folder).ravel()  # its dark level carries shot noise
    variance_e2 = (mean_e.sum() / shape.sum() * shape + background_e + 1.0**2) / 60
    flux = np.sum(shape * mean_e / variance_e2) / np.sum(shape**2 / variance_e2)
    chi2 = np.sum((mean_e - flux * shape) ** 2 / variance_e2)
    assert 0.9 < chi2 / (mean_e.size - 1) < 1.15
