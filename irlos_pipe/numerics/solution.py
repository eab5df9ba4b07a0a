"""The outcome of a batch of fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

import torch


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Batch = TypeVar("Batch", bound=_Dataclass)

CONVERGED, MAX_ITERATIONS, STALLED, INVALID = "converged", "max_iterations", "stalled", "invalid"


@dataclass(frozen=True)
class Solution:
    """Outcome of a batch of fits."""

    values: torch.Tensor  # (batch, parameters), float64
    # (batch, parameters, parameters): inverse of the Hessian at the solution (Cramér–Rao bound plus prior)
    covariance: torch.Tensor
    status: list[str]  # `converged`, `max_iterations`, `stalled` or `invalid`, one per member
    iterations: torch.Tensor  # (batch,)
    objective: torch.Tensor  # (batch,): half of χ² (prior included) at the solution

    @classmethod
    def joined(cls, parts: Sequence[Solution]) -> Solution:
        return joined(parts, status=[s for part in parts for s in part.status])

    @property
    def converged(self) -> torch.Tensor:
        """True where the fit converged, (batch,)."""
        return torch.tensor([status == CONVERGED for status in self.status])

    @property
    def sigma(self) -> torch.Tensor:
        """Standard errors, (batch, parameters)."""
        return torch.diagonal(self.covariance, dim1=1, dim2=2).clamp_min(0).sqrt()

    def updated(self, where: torch.Tensor, other: Solution, better: torch.Tensor) -> Solution:
        """Return the batch with those members of `other` that are `better`, at the positions `where`."""
        status = list(self.status)
        for member, new in zip(where.tolist(), torch.nonzero(better)[:, 0].tolist(), strict=True):
            status[member] = other.status[new]
        return mixed(self, other, where, better, status=status)


def joined(parts: Sequence[Batch], **other: Any) -> Batch:
    """Put batches of one kind one after the other: their tensors are joined, `other` fields given."""
    tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in _tensors(parts[0])}
    return replace(parts[0], **tensors, **other)


def mixed(first: Batch, second: Batch, where: torch.Tensor, better: torch.Tensor, **other: Any) -> Batch:
    """The batch `first` with the `better` members of `second` at positions `where`; `other` fields given."""
    tensors = {
        name: getattr(first, name).index_copy(0, where, getattr(second, name)[better])
        for name in _tensors(first)
    }
    return replace(first, **tensors, **other)


def _tensors(batch: _Dataclass) -> list[str]:
    return [name for name, value in vars(batch).items() if isinstance(value, torch.Tensor)]
