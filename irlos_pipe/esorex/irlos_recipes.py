"""The recipes of the package as recipes of PyCPL, which pyesorex finds in this file.

Each takes a set of frames with the tags of `irlos_pipe.recipe.sof`, runs in a folder, and returns the FITS
products of the run.
"""

from pathlib import Path
from typing import Any

import cpl.core
import cpl.ui

import irlos_pipe
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.recipe import load_recipe
from irlos_pipe.recipe.sof import inputs_from

SETTINGS, OUTPUT = "settings", "output"
SEPARATOR = ";"


class _IrlosRecipe(cpl.ui.PyRecipe):
    """What all have in common; `_name` without ``irlos_`` is the recipe's."""

    _name = "irlos"
    _version = irlos_pipe.__version__
    _author = "The irlos_pipe developers"
    _email = ""
    _copyright = "BSD-3-Clause"
    _synopsis = "Base of the recipes of irlos_pipe"
    _description = "Not to be run itself."

    def __init__(self) -> None:
        super().__init__()
        self.parameters = cpl.ui.ParameterList(
            [
                cpl.ui.ParameterValue(
                    name=f"{self._name}.{SETTINGS}",
                    context=self._name,
                    description=f"stage.key=VALUE, several with '{SEPARATOR}' between",
                    default="",
                ),
                cpl.ui.ParameterValue(
                    name=f"{self._name}.{OUTPUT}",
                    context=self._name,
                    description="folder of the run",
                    default=self._name,
                ),
            ]
        )

    def run(self, frameset: cpl.ui.FrameSet, settings: dict[str, Any]) -> cpl.ui.FrameSet:
        """Run the recipe on the frames of a set and return its products.

        Raises
        ------
        RuntimeError
            With the one line of an error on the user's side.
        """
        name = self._name.removeprefix("irlos_")
        given = {key.rpartition(".")[2]: value for key, value in settings.items()}
        changed = [one.strip() for one in str(given.get(SETTINGS) or "").split(SEPARATOR) if one.strip()]
        folder = Path(str(given.get(OUTPUT) or self._name))
        try:
            inputs = inputs_from([(frame.file, frame.tag) for frame in frameset], name)
            outcome = run_recipe(load_recipe(name, changed, inputs), folder)
        except IrlosError as error:
            raise RuntimeError(str(error)) from error
        for lines in outcome.summary.values():
            for line in lines:
                cpl.core.Msg.info(self._name, line)
        if outcome.exit_code:
            cpl.core.Msg.warning(self._name, f"{outcome.status}: see {folder}/report.html")
        return cpl.ui.FrameSet([_frame(path) for path in sorted(folder.glob("*.fits"))])


def _frame(path: Path) -> cpl.ui.Frame:
    from astropy.io import fits

    tag = fits.getheader(path)["ESO PRO CATG"]
    return cpl.ui.Frame(str(path), tag=tag, group=cpl.ui.Frame.FrameGroup.PRODUCT)


class NcpaCalibration(_IrlosRecipe):
    """NCPAs of a calibration cube, and the offsets that correct them."""

    _name = "irlos_ncpa_calibration"
    _synopsis = "NCPAs of a calibration cube, and the offsets that correct them"
    _description = "Input: NCPA_CALIBRATION (cube), DARK (optional). Product: IRLOS_MODAL_OFFSETS."


class FullReduction(_IrlosRecipe):
    """NCPAs, correction, focus ramp and limiting magnitude."""

    _name = "irlos_full_reduction"
    _synopsis = "NCPAs, correction, focus ramp and limiting magnitude"
    _description = "Input: NCPA_CALIBRATION, DEFOCUS_RAMP, DARK (optional). Product: IRLOS_MODAL_OFFSETS."
