"""report.html: one section per stage, drawn from the products of a run."""

import os
from contextlib import suppress

# A backend that is not installed, as a notebook passes on to the programs that it starts, would be an error when
# matplotlib is imported. Figures are drawn into files here, by none; who shows some has it afterwards.
_backend = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib
finally:
    if _backend is not None:
        os.environ["MPLBACKEND"] = _backend
if _backend:
    with suppress(ValueError):
        matplotlib.rcParams["backend"] = _backend
