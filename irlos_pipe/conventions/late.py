"""PyTorch, imported by its first use: what is declared with it is at hand without waiting for it.

Modules that recipes are checked, planned and explained with take ``torch`` from here and use it in functions
and annotations only. Parts of SciPy load by themselves when used as ``scipy.PART``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any


class LateModule:
    """A module, `name` as in an import statement, that is imported when something of it is asked for.

    Where it is not installed, that raises the error `missing`, if there is one.
    """

    def __init__(self, name: str, missing: Exception | None = None) -> None:
        self._name, self._missing = name, missing

    def __getattr__(self, attribute: str) -> Any:
        """Return what the module calls so, and keep it: the next look-up finds it at once."""
        try:
            value = getattr(import_module(self._name), attribute)
        except ImportError as error:
            raise self._missing or error from None
        setattr(self, attribute, value)
        return value


if TYPE_CHECKING:
    import torch as torch
    from torch import Tensor as Tensor
else:
    torch = LateModule("torch")
    Tensor = Any  # for annotations
