"""A GPU that fails, or is too small, costs time and no result."""

import pytest
import torch

from irlos_pipe.numerics import parallel
from irlos_pipe.pipeline.resources import run_on_device

CARD_BYTES = 2**34


@pytest.fixture(autouse=True)
def card(monkeypatch):
    monkeypatch.setattr(parallel, "_gpu_bytes", lambda: CARD_BYTES)


def on_card(used: int, device: str) -> int:
    """Members in the pieces of something that needs twice the memory that a piece is made for, and more."""
    size = parallel.at_once(1, device)
    if device == "cuda" and used + size * 2 * parallel.PROCESSOR_BYTES > CARD_BYTES:
        raise torch.OutOfMemoryError("CUDA out of memory")
    return size


def test_pieces_are_smaller_where_the_memory_of_a_card_is_short(caplog):
    assert run_on_device(lambda device: on_card(0, device), "cuda") == (4, "cuda")
    assert [record.message for record in caplog.records] == [
        "the memory of the GPU is too short: begun again with smaller pieces"
    ]
    assert parallel.at_once(1, "cuda") == 32


def test_where_another_program_holds_a_card_the_processor_does_the_work(caplog):
    assert run_on_device(lambda device: on_card(CARD_BYTES, device), "cuda") == (1, "cpu")
    assert "the GPU failed (CUDA out of memory): begun again on the processor" in caplog.text


def test_an_error_that_is_none_of_the_card_is_raised():
    def wrong(device):
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        run_on_device(wrong, "cuda")
