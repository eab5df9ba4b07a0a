"""Pixels that come again. Truth: images of random numbers, and copies of them."""

import numpy as np
import pytest

from irlos_pipe.control.exposures import Accumulator, Read, Repeats


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(100.0, 10.0, (64, 64)).astype(np.float32)


def half_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.concatenate([one[:, :32], other[:, 32:]], axis=1)


@pytest.mark.parametrize(
    ("again", "repeated"),
    [
        (image(0), True),
        (half_of(image(0), image(9)), True),
        (half_of(image(9), image(0)), True),
        (image(0) + np.float32(1e-3) * image(8), False),
        (np.roll(image(0), 1, 1), False),
    ],
    ids=["copy", "left half", "right half", "with new noise", "displaced"],
)
def test_a_copy_is_known_again_whole_or_in_part(again, repeated):
    seen = Repeats()
    assert not any(seen.has(image(seed)) for seed in range(3))
    assert seen.has(again) is repeated


def test_an_exposure_counts_its_repeated_reads_and_not_those_that_come_twice():
    accumulator = Accumulator(2)
    images = [image(0), image(1), image(0), image(2)]
    reads = [Read(counter, 0.0, one) for counter, one in enumerate(images)]
    first, second = (one for read in [reads[0], *reads] for one in accumulator.add(read))
    assert (first.repeated, first.doubled, second.repeated) == (0, 1, 1)
