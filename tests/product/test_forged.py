"""Products, results and folders that somebody forged: one line that says what to do, or a page without them.

Truth: the exit codes of the contract. What is forged carries no checksum, as of an older version.
"""

import shutil
from pathlib import Path

import h5py
import pytest
from conftest import invoke
from fuzz import pristine
from fuzz.product_kinds import ODD_JSON, PRODUCT, SECTIONS, _unseal

pytestmark = pytest.mark.slow
READERS = ("show", "report", "status")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return pristine.write_run(tmp_path_factory.mktemp("whole"))


def looked_at(run: Path) -> None:
    """Every command that reads ends with a code of the contract, and with one line where it is an error."""
    for command in READERS:
        result = invoke(command, str(run / PRODUCT if command == "show" else run))
        assert result.exit_code in (0, 3, 4), (command, result.output)
        assert "unexpected" not in result.output and "Traceback" not in result.output, (
            command,
            result.output,
        )
        assert result.stderr.count("irlos: error: ") == int(result.exit_code == 3), (command, result.stderr)


@pytest.mark.parametrize("section", SECTIONS)
def test_a_section_that_makes_no_sense_is_reported(whole, tmp_path, section):
    for number, text in enumerate(ODD_JSON):
        run = tmp_path / str(number)
        shutil.copytree(whole, run)
        _unseal(run / PRODUCT)
        with h5py.File(run / PRODUCT, "r+") as file:
            del file[section]
            file[section] = text
        looked_at(run)


@pytest.mark.parametrize("content", ["{}", '{"schema": "irlos-results"}', "[]", "", '{"stages": []}', "\x00"])
def test_a_run_whose_results_lack_their_stages_is_reported(whole, tmp_path, content):
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").write_text(content)
    looked_at(run)
