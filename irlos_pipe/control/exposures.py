"""Reads are added up to the exposures of the loop, whatever happens to them on the way.

The counter of the recorder says which exposure a read belongs to, not the time at which it arrives: reads
that come late, twice or out of order neither spoil an exposure nor stop the loop, and no clock is needed.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from functools import cache

import numpy as np

# Exposures' worth of late reads in a row that mean that the recorder counts anew: of reads that were taken
# after the last exposure, and of any, should the clock have been set back as well.
RESTARTED_AFTER, RESTARTED_ANYWAY_AFTER = 3, 1000
LARGEST_GAP = 10_000_000  # reads: more, ten hours at 250 Hz, are not missing, the counter has jumped
# Pixels that come again: two reads of a detector are never the same to the last bit, be it in a part.
PATCH_PX = 8  # side: noise of a few steps of the converter never gives 64 pixels twice
PART = 0.125  # of the patches that vary, from which a read is a repetition
REMEMBERED = 1000  # reads whose patches are kept for comparison


@dataclass
class Repeats:
    """Remembers patches of recent reads by a number of 64 bits each."""

    _reads: deque[list[int]] = field(default_factory=deque)
    _seen: set[int] = field(default_factory=set)

    def has(self, image: np.ndarray) -> bool:
        """Return whether a part of an `image`, (rows, columns), has been there before; remember it.

        Patches without any structure, as of a masked or saturated region, do not count.
        """
        keys = _keys(image)
        known = sum(key in self._seen for key in keys)
        self._reads.append(keys)
        self._seen.update(keys)
        if len(self._reads) > REMEMBERED:
            self._seen.difference_update(self._reads.popleft())
        return known > 0 and known >= PART * len(keys)


@dataclass(frozen=True, eq=False)
class Read:
    counter: int  # of the recorder
    unix_s: float  # since 1970; NaN if not known
    image_e: np.ndarray  # (rows, columns), photo-electrons, dark and background subtracted
    recording: str = ""  # which it belongs to, where each has a counter of its own


@dataclass(frozen=True, eq=False)
class Exposure:
    index: int  # counter over the counts of an exposure
    image_e: np.ndarray  # (rows, columns), float64; empty where the reads have different windows
    reads: int  # in it
    expected: int  # in a complete one
    first_counter: int
    unix_s: float  # of the first read
    late: int = 0  # reads since the exposure before that came too late,
    doubled: int = 0  # that came again,
    missing: int = 0  # and that did not come
    restarted: bool = False  # the recorder began to count anew, or jumped further than reads go missing
    recording: str = ""  # of its reads
    repeated: int = 0  # reads in it whose pixels have been there before, under another counter


@dataclass
class _Tally:
    """Of the open exposure."""

    late: int = 0
    doubled: int = 0
    restarted: bool = False
    repeated: int = 0


@dataclass
class Accumulator:
    reads: int  # of an exposure
    step: int = 1  # of the counter from one read to the next
    last_index: int | None = None  # of the last exposure that is done: reads of earlier ones are late, too
    last_unix_s: float = math.nan  # of its first read; NaN if not known
    recording: str = ""  # of the last exposure: in another one counters begin again
    taken: int = 0  # reads that have become part of an exposure
    _repeats: Repeats = field(default_factory=Repeats)
    _open: dict[int, Read] = field(default_factory=dict)
    _tally: _Tally = field(default_factory=_Tally)
    _new_in_a_row: int = 0
    _late_in_a_row: int = 0
    _overtaken_in_a_row: int = 0

    def add(self, read: Read) -> list[Exposure]:
        """Take a `read`; return the exposures that it completes, in order."""
        done = [] if read.recording == self.recording else self.count_anew()
        self.recording = read.recording
        index = self._index(read)
        if self._is_late(index, read):
            return done
        if self._open and index != self._index(self._first):
            if index < self._index(self._first):  # of an exposure that another one has overtaken
                return done + self._overtaken()
            done += self.flush()
        if read.counter in self._open:
            self._tally.doubled += 1
            return done
        self._open[read.counter] = read
        self.taken += 1
        self._tally.repeated += self._repeats.has(read.image_e)
        if len(self._open) == self.reads:
            done += self.flush()
        return done

    def count_anew(self) -> list[Exposure]:
        """Close the open exposure, and expect any counter: that of another recording or recorder."""
        done = self.flush()
        self.last_index, self.last_unix_s = None, math.nan
        self._late_in_a_row = self._new_in_a_row = 0
        return done

    @property
    def unused(self) -> int:
        """Reads since the last exposure that came too late or twice, of which no record tells yet."""
        return self._tally.late + self._tally.doubled

    def flush(self) -> list[Exposure]:
        """Close the open exposure with what it has; an empty list if there is none."""
        if not self._open:
            return []
        index, first = self._index(self._first), self._first
        images = [self._open[counter].image_e for counter in sorted(self._open)]
        alike = len({image.shape for image in images}) == 1
        total_e = np.asarray(np.sum(images, axis=0, dtype=np.float64)) if alike else np.zeros((0, 0))
        skipped = 0 if self.last_index is None or self._tally.restarted else index - self.last_index - 1
        jumped = skipped * self.reads > LARGEST_GAP
        self._tally.restarted |= jumped
        exposure = Exposure(
            index=index,
            image_e=total_e,
            reads=len(images),
            expected=self.reads,
            first_counter=first.counter,
            unix_s=first.unix_s,
            missing=(0 if jumped else skipped * self.reads) + self.reads - len(images),
            recording=first.recording,
            **vars(self._tally),
        )
        self.last_index, self.last_unix_s = index, first.unix_s
        self._open, self._tally, self._overtaken_in_a_row = {}, _Tally(), 0
        return [exposure]

    def _overtaken(self) -> list[Exposure]:
        """One more read of before the open exposure: after many in a row, that had a wild counter."""
        self._tally.late += 1
        self._overtaken_in_a_row += 1
        if self._overtaken_in_a_row <= RESTARTED_AFTER * self.reads:
            return []
        done = self.count_anew()
        self._tally.restarted = True
        return done

    @property
    def _first(self) -> Read:
        return self._open[min(self._open)]

    def _index(self, read: Read) -> int:
        return read.counter // (self.reads * self.step)

    def _is_late(self, index: int, read: Read) -> bool:
        """Whether the exposure is done; many late reads in a row are those of a recorder started again."""
        if self.last_index is None or index > self.last_index:
            self._late_in_a_row = self._new_in_a_row = 0
            return False
        self._late_in_a_row += 1
        self._new_in_a_row += not read.unix_s <= self.last_unix_s
        self._tally.late += 1
        new, all_late = self._new_in_a_row, self._late_in_a_row
        if new <= RESTARTED_AFTER * self.reads and all_late <= RESTARTED_ANYWAY_AFTER * self.reads:
            return True
        self._late_in_a_row, self._new_in_a_row, self.last_index = 0, 0, None
        self._tally.late += len(self._open)
        self._tally.restarted, self._open = True, {}
        return False


def _keys(image: np.ndarray) -> list[int]:
    bits = np.ascontiguousarray(image, np.float32).view(np.uint32)
    rows, columns = (max(1, size // PATCH_PX) for size in bits.shape)
    height, width = bits.shape[0] // rows, bits.shape[1] // columns
    if not height or not width:
        return []
    patches = bits[: rows * height, : columns * width].reshape(rows, height, columns, width)
    flat = patches.swapaxes(1, 2).reshape(rows * columns, height * width)
    varied = (flat != flat[:, :1]).any(axis=1)
    by_pixel, by_patch = _random_bits(height * width), _random_bits(rows * columns)
    return (flat.astype(np.uint64) @ by_pixel + by_patch)[varied].tolist()


@cache
def _random_bits(count: int) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 1 << 64, count, np.uint64) | np.uint64(1)
