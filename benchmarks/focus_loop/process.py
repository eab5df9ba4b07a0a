"""The telescope as a process: writes reads into a ring, applies the command of the loop, notes the truth.

Started again after it was killed, it goes on with the next exposure. Without a pace it waits after every
exposure for the answer of the loop, for a while: an hour then takes as long as the loop needs for it.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from pydantic import TypeAdapter
from threadpoolctl import threadpool_limits

from benchmarks.focus_loop.telescope import Exposed, Night, Telescope
from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.ring import RingWriter

SLOTS = 256
PATIENCE_S, PATIENCE_FIRST_S = 1.0, 120.0  # longest waits for an answer, and for the loop to start
POLL_S = 0.0002


@click.command()
@click.argument("night", type=click.Path(path_type=Path))
@click.option("--ring", type=click.Path(path_type=Path), required=True)
@click.option("--command", type=click.Path(path_type=Path), required=True)
@click.option("--truth", type=click.Path(path_type=Path), required=True)
@click.option("--speed", type=float, default=0.0, help="Times real time; 0 waits for the loop.")
def main(night: Path, ring: Path, command: Path, truth: Path, speed: float) -> None:
    """Run the NIGHT, a JSON file."""
    with threadpool_limits(1):
        telescope = Telescope(TypeAdapter(Night).validate_json(night.read_text()), night.parent)
        first = len(truth.read_text().splitlines()) if truth.exists() else 0
        Feed(telescope, RingWriter(ring, (64, 64), SLOTS), Mailbox(command), truth, speed).run(first)


class Feed:
    """Exposures to the ring, commands to the telescope."""

    def __init__(self, telescope: Telescope, ring: RingWriter, mailbox: Mailbox, truth: Path, speed: float):
        self._telescope, self._ring, self._mailbox, self._speed = telescope, ring, mailbox, speed
        self._truth, self._held_back = truth, list[Read]()
        if (command := mailbox.read()) is not None:
            telescope.queue_nm.extend([command.offset_nm] * len(telescope.queue_nm))

    def run(self, first: int) -> None:
        """Expose from number `first` to the end."""
        started = time.monotonic()
        with open(self._truth, "a") as log:
            for index in range(first, self._telescope.night.exposures):
                exposed = self._telescope.expose(index)
                self._deliver(index, exposed)
                truth = {"exposure": index, "drift_nm": exposed.drift_nm, "residual_nm": exposed.residual_nm}
                log.write(json.dumps(truth) + "\n")
                log.flush()
                self._listen(exposed, started + (index - first + 1) / self._speed if self._speed else None)

    def _deliver(self, index: int, exposed: Exposed) -> None:
        """Write the reads, with what goes wrong on the way."""
        night, reads = self._telescope.night, list(exposed.reads)
        late, self._held_back = self._held_back, []
        if night.has("late", index):
            self._held_back = [reads.pop()]
        if night.has("missing", index):
            reads.pop(0)
        if night.has("swapped", index):
            reads.reverse()
        if night.has("doubled", index):
            reads = [copy for read in reads for copy in (read, read)]
        if night.has("nan", index):
            reads[0] = replace(reads[0], image_e=np.full_like(reads[0].image_e, np.nan))
        for position, read in enumerate([*reads[:1], *late, *reads[1:]]):
            self._ring.write(read, damaged=position == 1 and night.has("damaged", index))

    def _listen(self, exposed: Exposed, due: float | None) -> None:
        """Wait for the answer, or for the next exposure to begin, and note the command."""
        patience_s = PATIENCE_FIRST_S if self._mailbox.read() is None else PATIENCE_S
        until = due or time.monotonic() + patience_s
        least = exposed.reads[0].counter
        while time.monotonic() < until:
            command = self._mailbox.read()
            if due is None and command is not None and command.counter >= least:
                break
            time.sleep(POLL_S)
        command = self._mailbox.read()
        self._telescope.queue_nm.append(0.0 if command is None else command.offset_nm)


if __name__ == "__main__":
    main()
