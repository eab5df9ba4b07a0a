"""What a user has set for matplotlib, or a notebook for the programs it starts, changes no figure."""

import os
import subprocess
import sys

import pytest

DRAW = """
import hashlib, sys
import numpy as np
from irlos_pipe.report.drawing import svg
from irlos_pipe.report.images import thumbnail
drawn = svg("a", (3, 2), lambda figure: figure.subplots().plot([1, 2], [3, 4], label="x"))
image = thumbnail(np.outer(np.arange(1.0, 9), np.arange(1.0, 9)), "b")
print(hashlib.sha256((drawn + image).encode()).hexdigest())
"""
RC = """
text.usetex: True
savefig.dpi: 3000
figure.dpi: 3000
font.family: nonsense
backend: QtAgg
image.cmap: nonsense
"""


def drawn(folder, **environment: str) -> str:
    own = {name: value for name, value in os.environ.items() if not name.startswith(("MPL", "MATPLOTLIB"))}
    ended = subprocess.run(
        [sys.executable, "-c", DRAW],
        cwd=folder,
        env=own | {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, filter(None, sys.path)))} | environment,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.slow
def test_neither_a_backend_that_is_not_there_nor_a_matplotlibrc_changes_a_figure(tmp_path):
    plain = drawn(tmp_path)
    (tmp_path / "matplotlibrc").write_text(RC)
    assert drawn(tmp_path, MPLBACKEND="module://not_installed.backend") == plain


@pytest.mark.slow
def test_who_shows_figures_keeps_the_backend(tmp_path):
    code = (
        "import irlos_pipe.report, matplotlib, os; print(matplotlib.get_backend(), os.environ['MPLBACKEND'])"
    )
    environment = os.environ | {"MPLBACKEND": "pdf", "PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert told.stdout.split() == ["pdf", "pdf"]
