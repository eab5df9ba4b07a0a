"""Reads become exposures. Truth: sums written out; whatever the order, an exposure has the same bits."""

from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.control.exposures import Accumulator, Read, Repeats

READS = 4


def read(counter: int, value: float | None = None) -> Read:
    return Read(counter, 100.0 + counter, np.full((2, 3), counter if value is None else value))


def fed(counters, accumulator: Accumulator | None = None):
    accumulator = accumulator or Accumulator(READS)
    return [exposure for counter in counters for exposure in accumulator.add(read(counter))]


def test_the_order_of_arrival_does_not_change_a_bit():
    rng = np.random.default_rng(0)
    reads = [Read(counter, 0.0, rng.normal(size=(2, 3)) * 10.0**counter) for counter in range(READS)]
    sums = []
    for order in ([0, 1, 2, 3], [3, 1, 0, 2], [2, 3, 1, 0]):
        accumulator = Accumulator(READS)
        (exposure,) = [one for index in order for one in accumulator.add(reads[index])]
        sums.append(exposure.image_e)
    np.testing.assert_array_equal(sums[0], sums[1])
    np.testing.assert_array_equal(sums[0], sums[2])


@pytest.mark.parametrize(
    ("counters", "told"),
    [
        (range(8), [(0, 6.0, 4, 0, 0, 0), (1, 22.0, 4, 0, 0, 0)]),
        ([0, 1, 1, 2, 0, 3], [(0, 6.0, 4, 0, 2, 0)]),
        ([0, 2, 3, 4, 5, 6, 7], [(0, 5.0, 3, 0, 0, 1), (1, 22.0, 4, 0, 0, 0)]),
        ([0, 2, 3, 4, 1, 5, 6, 7], [(0, 5.0, 3, 0, 0, 1), (1, 22.0, 4, 1, 0, 0)]),
        ([0, 1, 2, 3, 12, 13, 14, 15], [(0, 6.0, 4, 0, 0, 0), (3, 54.0, 4, 0, 0, 8)]),
    ],
    ids=["all", "twice", "missing", "late", "exposures lost"],
)
def test_an_exposure_says_which_reads_came_twice_late_or_not(counters, told):
    found = fed(counters)
    numbers = [(one.index, one.image_e[0, 0], one.reads, one.late, one.doubled, one.missing) for one in found]
    assert numbers == told and (found[0].first_counter, found[0].unix_s) == (0, 100.0)


def test_after_a_restart_what_is_done_is_not_done_again():
    exposures = fed(range(12), Accumulator(READS, last_index=1))
    assert [one.index for one in exposures] == [2]
    assert exposures[0].late == 8


def test_a_recorder_that_counts_anew_is_followed_after_a_few_exposures():
    accumulator = Accumulator(READS)
    fed(range(4000, 4008), accumulator)
    later = [Read(counter, 9000.0 + counter, np.zeros((2, 3))) for counter in range(40)]
    exposures = [one for read in later for one in accumulator.add(read)]
    assert exposures[0].restarted
    assert exposures[0].index <= 4
    assert not any(one.restarted for one in exposures[1:])
    assert [one.index for one in exposures] == list(range(exposures[0].index, 10))


def test_reads_with_different_windows_make_no_image():
    accumulator = Accumulator(2)
    accumulator.add(read(0))
    (exposure,) = accumulator.add(Read(1, 0.0, np.zeros((5, 5))))
    assert exposure.image_e.shape == (0, 0)


def of(recording: str, *counters: int) -> list[Read]:
    return [Read(counter, 0.0, np.zeros((2, 3)), recording) for counter in counters]


def test_every_recording_counts_by_itself_and_none_is_late_or_missing():
    accumulator = Accumulator(2)
    reads = [*of("b", 10, 11, 12), *of("a", 0, 1, 2, 3), *of("c", 90, 91)]
    exposures = [one for read in reads for one in accumulator.add(read)]
    assert [(one.recording, one.index, one.reads) for one in exposures] == [
        ("b", 5, 2),
        ("b", 6, 1),
        ("a", 0, 2),
        ("a", 1, 2),
        ("c", 45, 2),
    ]
    assert [(one.late, one.missing, one.restarted) for one in exposures] == [
        (0, 0, False),
        (0, 1, False),
        *[(0, 0, False)] * 3,
    ]


def test_one_read_with_a_wild_counter_costs_some_exposures_and_no_more():
    accumulator = Accumulator(READS)
    reads = [*map(read, range(4)), replace(read(4), counter=2**62), *map(read, range(5, 60))]
    exposures = [exposure for one in reads for exposure in accumulator.add(one)]
    assert exposures[-1].index == 14
    assert sum(one.reads == READS for one in exposures) >= 10
    assert sum(one.reads + one.late for one in exposures) + accumulator.unused == 60


# Pixels that come again. Truth: images of random numbers, and copies of them.


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
