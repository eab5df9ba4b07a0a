"""Reads are added up to the exposures of the loop, whatever happens to them on the way.

The counter of the recorder says which exposure a read belongs to, not the time at which it arrives: reads
that come late, twice or out of order neither spoil an exposure nor stop the loop, and no clock is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from irlos_pipe.control.repeats import Repeats

# Exposures' worth of late reads in a row that mean that the recorder counts anew: of reads that were taken
# after the last exposure, and of any, should the clock have been set back as well.
RESTARTED_AFTER, RESTARTED_ANYWAY_AFTER = 3, 1000
LARGEST_GAP = 10_000_000  # reads: more, ten hours at 250 Hz, are not missing, the counter has jumped


@dataclass(frozen=True, eq=False)
class Read:
    """One read of the detector.

    Attributes
    ----------
    counter : int
        Of the recorder.
    unix_s : float
        Time since 1970; NaN if not known.
    image_e : ndarray, (rows, columns)
        Photo-electrons, dark and background subtracted.
    recording : str
        Which it belongs to, where each recording has a counter of its own; else empty.
    """

    counter: int
    unix_s: float
    image_e: np.ndarray
    recording: str = ""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Reads added up.

    Attributes
    ----------
    index : int
        Number of the exposure: counter over the counts of an exposure.
    image_e : ndarray, (rows, columns), float64
        Empty where the reads have different windows.
    reads, expected : int
        Reads in it, and those of a complete one.
    first_counter : int
    unix_s : float
        Time of the first read.
    late, doubled, missing : int
        Reads since the exposure before: come too late, come again, and not come.
    restarted : bool
        Whether the recorder began to count anew, or the counter jumped further than reads go missing.
    recording : str
        Of its reads.
    repeated : int
        Reads in it whose pixels have been there before, under another counter.
    """

    index: int
    image_e: np.ndarray
    reads: int
    expected: int
    first_counter: int
    unix_s: float
    late: int = 0
    doubled: int = 0
    missing: int = 0
    restarted: bool = False
    recording: str = ""
    repeated: int = 0


@dataclass
class _Tally:
    late: int = 0
    doubled: int = 0
    restarted: bool = False
    repeated: int = 0


@dataclass
class Accumulator:
    """Adds up reads.

    Attributes
    ----------
    reads : int
        Of an exposure.
    step : int
        Of the counter from one read to the next.
    last_index : int or None
        The last exposure that is done: reads of it and of earlier ones are late.
    last_unix_s : float
        Time of its first read; NaN if not known.
    recording : str
        Of the last exposure: in another one counters begin again.
    taken : int
        Reads that have become part of an exposure.
    """

    reads: int
    step: int = 1
    last_index: int | None = None
    last_unix_s: float = math.nan
    recording: str = ""
    taken: int = 0
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
        skipped = 0 if self.last_index is None or self._tally.restarted else index - self.last_index - 1
        jumped = skipped * self.reads > LARGEST_GAP
        exposure = Exposure(
            index=index,
            image_e=_total(images),
            reads=len(images),
            expected=self.reads,
            first_counter=first.counter,
            unix_s=first.unix_s,
            late=self._tally.late,
            doubled=self._tally.doubled,
            missing=(0 if jumped else skipped * self.reads) + self.reads - len(images),
            restarted=self._tally.restarted or jumped,
            recording=first.recording,
            repeated=self._tally.repeated,
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


def _total(images: list[np.ndarray]) -> np.ndarray:
    if len({image.shape for image in images}) > 1:
        return np.zeros((0, 0))
    return np.asarray(np.sum(images, axis=0, dtype=np.float64))
