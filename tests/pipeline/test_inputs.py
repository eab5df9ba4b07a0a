"""A product is out of date when a file that ingest read changes, and only then; every layout."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, loop_table, star, write_muse, write_recorder, write_sidecar

from irlos_pipe.pipeline import Selection, plan_run, run_recipe
from irlos_pipe.pipeline.plan import input_files
from irlos_pipe.recipe import load_recipe

RECIPE = "recipe: test\ninputs: {cube: data}\nstages: [ingest]\n"
PIXELS = counts(star(12, 12), frames=3)
LEVEL = np.full((12, 12), 50.0)
MAPS = {"DARK": LEVEL, "BACKGROUND": 0 * LEVEL, "FLAT": LEVEL, "DEAD": 0 * LEVEL, "WEIGHT": LEVEL}
TIMES = {"Seconds": 1700000000 + np.arange(3), "USeconds": np.zeros(3, int)}
LOOP = loop_table(20 * np.arange(3), np.full(3, 1700000000), 1000 * np.arange(3))


def loop_file(path: Path, *, with_times: bool = True) -> None:
    path.parent.mkdir(exist_ok=True)
    table = LOOP if with_times else loop_table([0], [0], [0])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path)


def recorder(data: Path) -> Path:
    """Everything in one folder; the loop table is searched for in the order of names."""
    path = write_recorder(data / "sky", PIXELS, maps=MAPS)
    loop_file(path.with_name("a.fits"), with_times=False)
    loop_file(path.with_name("loop.fits"))
    loop_file(path.with_name("z.fits"))
    (path.with_name("notes.txt")).write_text("clear")
    return path


def recorder_with_times(data: Path) -> Path:
    path = write_recorder(data / "sky", PIXELS, times=TIMES)
    loop_file(path.with_name("loop.fits"))
    return path


def recorder_in_two_folders(data: Path) -> Path:
    """GALACSI: pixels in NAME_IR_PIX, loop and calibration in NAME_IR."""
    path = write_recorder(data / "sky_IR_PIX", PIXELS, maps={"FLAT": LEVEL})
    loop_file(data / "sky_IR" / "sky_IR.fits")
    for kind in ("DARK", "FLAT"):
        fits.writeto(data / "sky_IR" / f"IRAcq.DET1.{kind}.fits", LEVEL)
    return path


def cube(data: Path) -> Path:
    data.mkdir()
    fits.writeto(data / "sky.fits", PIXELS)
    write_sidecar(data / "sky.yaml")
    write_sidecar(data / "acquisition.yaml")
    fits.writeto(data / "IRAcq.DET1.DARK.fits", LEVEL)
    return data / "sky.fits"


def muse(data: Path) -> Path:
    data.mkdir()
    write_sidecar(data / "acquisition.yaml")
    return write_muse(data / "sky.fits", PIXELS)


def aot(data: Path) -> Path:
    aotpy = pytest.importorskip("aotpy")
    data.mkdir()
    system = aotpy.AOSystem(ao_mode="LTAO", name="GALACSI")
    system.main_telescope = aotpy.MainTelescope(uid="UT4")
    detector = aotpy.Detector(uid="IRLOS", pixel_intensities=aotpy.Image("pixels", PIXELS))
    system.scoring_cameras.append(aotpy.ScoringCamera(uid="camera", detector=detector))
    system.write_to_file(data / "sky.fits")
    write_sidecar(data / "sky.yaml")
    return data / "sky.fits"


def altered(path: Path) -> None:
    """Change the content so that the file can still be read."""
    if path.suffix != ".fits":
        path.write_text(path.read_text() + "\n# seen again\n")
        return
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["COMMENT"] = "seen again"


READ = {
    recorder: [
        "sky/sky.fits",
        *(f"sky/IRAcq.DET1.{kind}.fits" for kind in MAPS),
        "sky/acquisition.yaml",
        "sky/a.fits",
        "sky/loop.fits",
    ],
    recorder_with_times: ["sky/sky.fits", "sky/acquisition.yaml"],
    recorder_in_two_folders: [
        "sky_IR_PIX/sky_IR_PIX.fits",
        "sky_IR_PIX/IRAcq.DET1.FLAT.fits",
        "sky_IR_PIX/acquisition.yaml",
        "sky_IR/IRAcq.DET1.DARK.fits",
        "sky_IR/sky_IR.fits",
    ],
    cube: ["sky.fits", "sky.yaml"],
    muse: ["sky.fits", "acquisition.yaml"],
    aot: ["sky.fits", "sky.yaml"],
}
NOT_READ = {
    recorder: ["sky/z.fits", "sky/notes.txt"],
    recorder_with_times: ["sky/loop.fits"],
    recorder_in_two_folders: ["sky_IR/IRAcq.DET1.FLAT.fits"],
    cube: ["acquisition.yaml", "IRAcq.DET1.DARK.fits"],
}


def planned(folder: Path, given: Path) -> str:
    """Why ingest would run on what is given."""
    recipe = load_recipe(folder / "recipe.yaml", inputs=[f"cube={given}"])
    (step,) = plan_run(recipe, folder / "out", Selection())[1]
    return step.reason


@pytest.fixture
def finished(tmp_path):
    """Run ingest on a layout, given as its folder or its data file."""

    def finish(layout: Callable[[Path], Path], *, as_file: bool) -> Path:
        path = layout(tmp_path / "data")
        (tmp_path / "recipe.yaml").write_text(RECIPE)
        given = path if as_file else path.parent
        run_recipe(load_recipe(tmp_path / "recipe.yaml", inputs=[f"cube={given}"]), tmp_path / "out")
        assert planned(tmp_path, given) == "up to date"
        return given

    return finish


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("layout", READ, ids=lambda layout: layout.__name__)
@pytest.mark.parametrize("as_file", [True, False], ids=["file", "folder"])
@pytest.mark.slow
def test_a_product_is_out_of_date_when_a_file_changes_that_was_read(tmp_path, finished, layout, as_file):
    given = finished(layout, as_file=as_file)
    for file in [*READ[layout], *NOT_READ.get(layout, [])]:
        path = tmp_path / "data" / file
        before = path.read_bytes()
        altered(path)
        reason = planned(tmp_path, given)
        path.write_bytes(before)
        if file in READ[layout]:
            assert reason.startswith("input file cube/") and reason.endswith(f"{path.name} changed"), file
        else:
            assert reason == "up to date", file


@pytest.mark.parametrize(
    ("make", "name", "expected"),
    [
        (lambda dark: fits.writeto(dark, LEVEL), "IRAcq.DET1.DARK.fits", "IRAcq.DET1.DARK.fits is new"),
        (loop_file, "loop.fits", "loop.fits is new"),
        (write_sidecar, "sky.yaml", "acquisition.yaml is gone"),
    ],
)
def test_a_file_that_will_be_read_and_was_not_there_makes_a_product_out_of_date(
    tmp_path, finished, make, name, expected
):
    given = finished(lambda data: write_recorder(data / "sky", PIXELS), as_file=True)
    make(given.with_name(name))
    assert f"input file cube/{expected}" in planned(tmp_path, given)


@pytest.mark.slow
def test_a_damaged_recording_counts_until_it_is_mended(tmp_path, finished):
    """Its other recordings are read all the same."""

    def two(data: Path) -> Path:
        write_recorder(data / "broken", PIXELS).write_bytes(b"SIMPLE  = nothing more")
        return write_recorder(data / "sky", PIXELS)

    finished(two, as_file=False)
    data = tmp_path / "data"
    run_recipe(load_recipe(tmp_path / "recipe.yaml", inputs=[f"cube={data}"]), tmp_path / "out")
    assert planned(tmp_path, data) == "up to date"
    (data / "broken" / "broken.fits").unlink()
    write_recorder(data / "broken", PIXELS)
    assert planned(tmp_path, data) == "input file cube/data/broken/broken.fits changed"


@pytest.mark.parametrize("content", ['{"lists": 3}', '{"lists": {"x": 1}}', "[]", '{"lists": []}'])
def test_a_cache_that_makes_no_sense_is_not_used(tmp_path, content):
    (tmp_path / ".input_checksums.json").write_text(content)
    path = cube(tmp_path / "data")
    (found,) = input_files({"cube": (path,)}, tmp_path, lambda root: [root])
    assert found.path == path
