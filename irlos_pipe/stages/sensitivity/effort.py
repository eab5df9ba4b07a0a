"""What a sensitivity scan will take, said and judged before its work begins."""

from __future__ import annotations

import logging

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.limits import require_memory

BYTES_PER_PIXEL = 40  # of every image that is estimated at once; 24 to 29 were measured with 48x48 px
MANY = 20_000  # estimates; a processor makes some hundred per second of 64x64 px


def announce(
    frames: int,
    window: tuple[int, int],
    realisations: int,
    magnitudes: int,
    curves: int,
    log: logging.Logger,
) -> None:
    """Say how many estimates there will be, as a warning where it takes minutes.

    Parameters
    ----------
    frames : int
        Bright frames that are dimmed.
    window : (int, int)
        Their rows and columns [px].
    realisations, magnitudes, curves : int
        Draws of the noise of every frame, magnitudes of a curve, and curves.
    log : logging.Logger

    Raises
    ------
    ConfigurationError
        Where the memory does not suffice for one magnitude.
    """
    rows, columns = window
    at_once = frames * realisations
    estimates = at_once * magnitudes * curves
    text = (
        f"{estimates} estimates of {rows}x{columns} px: {frames} frames x {realisations} realisations x "
        f"{magnitudes} magnitudes x {curves} curves"
    )
    advice = "lower sensitivity.realisations or sensitivity.frames_per_offset"
    require_memory(BYTES_PER_PIXEL * at_once * rows * columns, text, ConfigurationError, advice)
    log.log(logging.WARNING if estimates > MANY else logging.INFO, "%s", text)
