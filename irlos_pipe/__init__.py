"""Focal-plane wavefront sensing for the IRLOS sensor of MUSE's narrow-field mode.

The names in ``__all__`` are the interface for Python programs. They are imported when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

# Name: the module it comes from, in the order of use.
_HOMES = {
    "load_recipe": "recipe",
    "run": "api.running",
    "open_run": "api.running",
    "read_product": "product.storage",
    "calibrate": "api.reducing",
    "lift": "api.reducing",
    "diagnose": "api.reducing",
    "figures": "report.figures",
    "read_recordings": "api.recordings",
    "load_instrument": "instrument.instrument",
    "PsfModel": "optics.psf",
    "PsfSettings": "optics.psf_settings",
    "Focus": "estimate.focus.sensor",
    "explain": "reference.lookup",
}
__all__ = list(_HOMES)  # noqa: PLE0605

if TYPE_CHECKING:
    from irlos_pipe.api.recordings import read_recordings
    from irlos_pipe.api.reducing import calibrate, diagnose, lift
    from irlos_pipe.api.running import open_run, run
    from irlos_pipe.estimate.focus.sensor import Focus
    from irlos_pipe.instrument.instrument import load_instrument
    from irlos_pipe.optics.psf import PsfModel
    from irlos_pipe.optics.psf_settings import PsfSettings
    from irlos_pipe.product.storage import read_product
    from irlos_pipe.recipe import load_recipe
    from irlos_pipe.reference.lookup import explain
    from irlos_pipe.report.figures import figures


def __getattr__(name: str) -> Any:
    """Import one of the names of the interface."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the interface and of the module itself."""
    return sorted({*globals(), *_HOMES})
