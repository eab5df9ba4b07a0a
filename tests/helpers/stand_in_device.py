"""A stand-in for a GPU where there is none: tensors on the CPU of which some count as being on ``cuda``.

Inside a `StandInDevice` every tensor that is made on, moved to, or computed from tensors on the device is
remembered. As on a real one, an operation that mixes it with tensors elsewhere is an error, and so is its
conversion to NumPy; scalars, the source of a copy, and indices of what is on the device may be anywhere.
"""

from collections.abc import Iterator
from itertools import chain

import torch
from torch.overrides import TorchFunctionMode
from torch.utils.weak import WeakIdKeyDictionary

DEVICE = "cuda"
TO_NUMPY = (torch.Tensor.numpy, torch.Tensor.__array__)
ITEMS = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)
INTO_FIRST = (*ITEMS, torch.Tensor.copy_)


class MixedDevicesError(RuntimeError):
    """Tensors of two devices in one operation."""


class StandInDevice(TorchFunctionMode):
    """While it is active, ``cuda`` exists; `operations` counts what was computed on it."""

    def __init__(self):
        super().__init__()
        self.there, self.operations = WeakIdKeyDictionary(), 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function == torch.Tensor.device.__get__:
            return torch.device(DEVICE if args[0] in self.there else "cpu")
        if function in TO_NUMPY and args[0] in self.there:
            raise TypeError(f"can't convert a tensor on {DEVICE} to numpy; use Tensor.cpu() first")
        if function is torch.autograd.grad:
            return self._gradients(*args, **kwargs)
        target = self._target(function, args, kwargs)
        if target is None and self._mixes(function, args, kwargs):
            raise MixedDevicesError(f"{function.__name__} of tensors on {DEVICE} and on the CPU")
        stays = target == DEVICE or (target is None and self._follows(function, args, kwargs))
        result = function(*_without_device(args), **{k: v for k, v in kwargs.items() if k != "device"})
        if target is not None and args and result is args[0] and stays != (result in self.there):
            result = result.clone()  # moved, and so another tensor
        if stays:
            self.operations += 1
            _remember(self.there, tensors(result))
        return result

    def _gradients(self, outputs, inputs, **options):
        """Derivatives are where the inputs are, wherever the outputs are."""
        found = torch.autograd.grad(outputs, inputs, **options)
        _remember(self.there, [one for one, own in zip(found, inputs, strict=True) if own in self.there])
        return found

    def _target(self, function, args, kwargs) -> str | None:
        if function is torch.Tensor.cpu:
            return "cpu"
        if function is torch.Tensor.to and isinstance(args[1], torch.Tensor):
            return DEVICE if args[1] in self.there else "cpu"
        named = [a for a in (*args, kwargs.get("device")) if _is_device(a)]
        return str(named[0]) if named else None

    def _mixes(self, function, args, kwargs) -> bool:
        if function is torch.Tensor.copy_:
            return False
        if function in ITEMS:
            return self._mixes_items(*args)
        return len({tensor in self.there for tensor in tensors((args, kwargs)) if tensor.ndim}) > 1

    def _mixes_items(self, tensor, index, value=None) -> bool:
        """Indices may be on the CPU; what is put in place of a slice may come from anywhere."""
        indices = [one for one in tensors(index) if one.ndim]
        put = [one for one in tensors(value) if one.ndim] if indices else []
        here = tensor in self.there
        foreign_index = any(one in self.there and not here for one in indices)
        return foreign_index or any((one in self.there) != here for one in put)

    def _follows(self, function, args, kwargs) -> bool:
        """Whether what is computed from these is on the device."""
        sources = args[:1] if function in INTO_FIRST else (args, kwargs)
        return any(tensor in self.there for tensor in tensors(sources))


def _remember(there, found) -> None:
    for tensor in found:
        there[tensor] = True


def _is_device(argument) -> bool:
    return isinstance(argument, (str, torch.device)) and str(argument) in (DEVICE, "cpu")


def _without_device(args: tuple) -> tuple:
    return tuple(argument for argument in args if not _is_device(argument))


def tensors(nested) -> Iterator[torch.Tensor]:
    if isinstance(nested, torch.Tensor):
        return iter([nested])
    if isinstance(nested, dict):
        nested = list(nested.values())
    if isinstance(nested, (tuple, list)):
        return chain.from_iterable(map(tensors, nested))
    return iter(())
