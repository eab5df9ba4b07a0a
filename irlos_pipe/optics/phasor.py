"""Complex exponentials of real phases."""

from __future__ import annotations

from irlos_pipe.conventions.late import torch


def phasor(phase: torch.Tensor) -> torch.Tensor:
    """``exp(iφ)`` of phases φ [rad]; cosine and sine are computed by vector instructions, it is not."""
    return torch.complex(phase.cos(), phase.sin())
