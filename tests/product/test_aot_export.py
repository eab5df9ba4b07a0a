"""Recordings written as AOT files; truth is the recording itself, read back by the reader of the package."""

import json

import numpy as np
import pytest
from conftest import invoke
from helpers import sparta_files

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.product.storage import read_product
from irlos_pipe.readers.find import read_recordings

RECIPE = "recipe: one\ninputs: {cube: data}\nstages: [ingest]\n"
TIMES = {"Seconds": 1707620400 + np.arange(5), "USeconds": np.arange(5) * 1000}

pytestmark = pytest.mark.filterwarnings("ignore")


def ingested(folder, data):
    recipe = folder / "one.yaml"
    recipe.write_text(RECIPE)
    result = invoke("run", str(recipe), "--input", f"cube={data}", "--output", str(folder / "run"), "-q")
    assert result.exit_code in (0, 4), result.stderr
    return folder / "run" / "01_ingest.h5"


@pytest.mark.slow
def test_a_recording_that_is_written_and_read_again_is_the_same(tmp_path):
    adu = sparta_files.counts(sparta_files.star(32, 32), frames=5)
    detector = {"e_per_adu": 0.5, "read_noise_e": 1.0, "coadds": 4, "saturation_adu": 65000.0}
    keys = {"introduced_defocus_nm": 12.5, "detector": detector}
    sparta_files.write_recorder(tmp_path / "cube", adu, times=TIMES, keys=keys)
    product, path = ingested(tmp_path, tmp_path / "cube"), tmp_path / "aot.fits"
    assert invoke("export", str(product), "--aot", "cube", "--output", str(path)).exit_code == 0
    (raw,) = read_recordings(path, load_instrument("irlos"))
    (first,) = read_recordings(tmp_path / "cube" / "cube.fits", load_instrument("irlos"))
    assert raw.layout == "aot" and np.array_equal(raw.adu, first.adu)
    assert np.array_equal(raw.frame_counter, first.frame_counter)
    assert raw.unix_s == pytest.approx(first.unix_s, abs=1e-6)
    assert raw.header["pixel_scale_mas"] == pytest.approx(9.7) and raw.header["exposure_s"] == 0.1
    (tmp_path / "again").mkdir()
    before, after = read_product(product), read_product(ingested(tmp_path / "again", path))
    images = before.arrays["recordings/cube/cube/images_e"].value
    again = after.arrays["recordings/cube/aot/images_e"].value
    assert again == pytest.approx(images, abs=0.2)  # the read noise is 2 e-
    told = [json.loads(str(one.arrays[f"recordings/cube/{name}/acquisition"].value))
            for one, name in ((before, "cube"), (after, "aot"))]  # fmt: skip
    for key in ("detector", "spectrum", "diversity", "role", "target", "mag_j"):
        assert told[1][key] == told[0][key]
    defocus = after.arrays["recordings/cube/aot/introduced_defocus_nm"].value
    assert defocus == pytest.approx(12.5)
