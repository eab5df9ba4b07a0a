"""report.html: one section per stage, drawn from the products of a run."""

import os
from contextlib import suppress

# A backend that is not installed, as a notebook hands on to the programs that it starts, would be an error
# when matplotlib is imported. Nothing is shown here; whoever shows figures has the backend afterwards.
if _backend := os.environ.pop("MPLBACKEND", None):
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = _backend
    with suppress(ValueError):
        matplotlib.rcParams["backend"] = _backend
