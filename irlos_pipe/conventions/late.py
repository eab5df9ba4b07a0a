"""PyTorch, imported by its first use: what is declared with it is at hand without waiting for it.

Modules that recipes are checked, planned and explained with take ``torch`` from here and use it in functions
and annotations only. Parts of SciPy load by themselves when used as ``scipy.PART``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any


class LateModule:
    """A module, `name` as in an import statement, that is imported when something of it is asked for."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        """Return what the module calls so, and keep it: the next look-up finds it at once."""
        value = getattr(import_module(self._name), attribute)
        setattr(self, attribute, value)
        return value


if TYPE_CHECKING:
    import torch as torch
    from torch import Tensor as Tensor
else:
    torch = LateModule("torch")
    Tensor = Any  # for annotations
