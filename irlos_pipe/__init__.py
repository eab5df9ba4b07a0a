"""Focal-plane wavefront sensing for the IRLOS sensor of MUSE's narrow-field mode.

The names in ``__all__`` are the interface for Python programs. Each is imported when it is first used; type
checkers read them in ``__init__.pyi``.
"""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

# Name: the module it comes from, in the order of use.
HOMES = {
    "load_recipe": "recipe",
    "run": "api.running",
    "open_run": "api.running",
    "read_product": "product.storage",
    "figures": "report.build",
    "calibrate": "api.reducing",
    "lift": "api.reducing",
    "diagnose": "api.reducing",
    "Reduction": "api.reducing",
    "noll_nm": "optics.zernike",
    "read_recordings": "api.reducing",
    "load_instrument": "instrument.instrument",
    "PsfModel": "optics.psf",
    "PsfSettings": "optics.psf_settings",
    "Focus": "estimate.focus",
    "explain": "reference.lookup",
    "ConfigurationError": "conventions.errors",
    "InputDataError": "conventions.errors",
}
__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    """Import one of the names of the interface."""
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(import_module(f"{__name__}.{HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the interface and of the module itself."""
    return sorted({*globals(), *HOMES})
