"""The four images of a 2x2 lenslet array in one frame."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.errors import InputDataError


def split_quadrants(cube: np.ndarray, where: str) -> list[np.ndarray]:
    """Split frames into the images of the four lenslets, without the border of zeros around each.

    Parameters
    ----------
    cube : ndarray, (frames, rows, columns)
        Both window sides even; each quadrant has a border of zeros one pixel wide.
    where : str
        Begins the message of an error.

    Returns
    -------
    list of ndarray, (frames, rows / 2 - 2, columns / 2 - 2)
        Lower left, lower right, upper left, upper right (row index is y, upwards).

    Raises
    ------
    InputDataError
        A window that cannot be halved, or a border that is not zero.
    """
    rows, columns = cube.shape[1:]
    if rows % 2 or columns % 2:
        raise InputDataError(
            f"{where}: a window of {rows}x{columns} px has no four equal quadrants, "
            "which the 2x2 mode of the header asks for"
        )
    quadrants = [
        cube[:, y : y + rows // 2, x : x + columns // 2] for y in (0, rows // 2) for x in (0, columns // 2)
    ]
    for number, quadrant in enumerate(quadrants, start=1):
        border = np.ones(quadrant.shape[1:], dtype=bool)
        border[1:-1, 1:-1] = False
        if np.any(quadrant[:, border] != 0):
            raise InputDataError(
                f"{where}: quadrant {number} lacks the one-pixel border of zeros of a 2x2 mode"
            )
    return [np.ascontiguousarray(quadrant[:, 1:-1, 1:-1]) for quadrant in quadrants]
