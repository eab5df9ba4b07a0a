"""The shell for PyCPL: against PyCPL where it is installed, else against a stand-in of what is used of it."""

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
from helpers import sparta_files

MODULE = "irlos_pipe.esorex.irlos_recipes"
SETTINGS = "calibrate.method=lift_slices; calibrate.highest_noll=6; model.pupil_samples=48"


def stand_in() -> dict[str, ModuleType]:
    """The classes that a recipe uses, with the attributes that PyCPL documents."""

    class PyRecipe:
        pass

    @dataclass
    class Frame:
        file: str
        tag: str = ""
        group: str = ""

        class FrameGroup:
            PRODUCT = "product"

    @dataclass
    class ParameterValue:
        name: str
        context: str
        description: str
        default: object

    class Msg:
        info = warning = staticmethod(lambda component, message: None)

    cpl, core, ui = ModuleType("cpl"), ModuleType("cpl.core"), ModuleType("cpl.ui")
    core.Msg = Msg
    ui.PyRecipe, ui.Frame, ui.ParameterValue = PyRecipe, Frame, ParameterValue
    ui.FrameSet, ui.ParameterList = list, list
    cpl.core, cpl.ui = core, ui
    return {"cpl": cpl, "cpl.core": core, "cpl.ui": ui}


@pytest.fixture
def recipes(monkeypatch):
    try:
        importlib.import_module("cpl.ui")
    except ImportError:
        for name, module in stand_in().items():
            monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    yield importlib.import_module(MODULE)
    sys.modules.pop(MODULE, None)


@pytest.mark.slow
def test_a_set_of_frames_gives_the_product_with_its_category(recipes, tmp_path):
    import cpl.ui

    adu = sparta_files.counts(sparta_files.star(32, 32), frames=6)
    sparta_files.write_recorder(tmp_path / "cube", adu)
    frames = cpl.ui.FrameSet([cpl.ui.Frame(str(tmp_path / "cube" / "cube.fits"), tag="NCPA_CALIBRATION")])
    recipe = recipes.NcpaCalibration()
    name = recipe._name
    products = recipe.run(frames, {f"{name}.settings": SETTINGS, f"{name}.output": str(tmp_path / "run")})
    assert [(Path(one.file).name, one.tag) for one in products] == [
        ("correction.fits", "IRLOS_MODAL_OFFSETS")
    ]


def test_an_error_on_the_users_side_is_one_line(recipes):
    import cpl.ui

    frames = cpl.ui.FrameSet([cpl.ui.Frame("a.fits", tag="FLAT")])
    with pytest.raises(RuntimeError, match="no input for the tag 'FLAT'"):
        recipes.NcpaCalibration().run(frames, {})
