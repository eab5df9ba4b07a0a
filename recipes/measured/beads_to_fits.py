"""Make a FITS cube with a side-car from the bead's focus ramp that pyOTF publishes as a fixture.

``python beads_to_fits.py RAMP OUTPUT_FOLDER``; RAMP is the TIFF file (25 planes, needs Pillow), or an npz
file with the planes as ``cube``.

Source of the data: github.com/david-hoffman/pyOTF, folder fixtures, Apache-2.0.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml
from astropy.io import fits

from irlos_pipe.optics.defocus import defocus_nm_per_um

SINE, STEP_UM, WAVELENGTH_NM, PIXEL_MAS = (
    0.85,
    0.3,
    520.0,
    26.8144,
)  # as the file's name says; 130 nm over 1 m
WINDOW = 81  # about the brightest pixel; odd


def planes(path: Path) -> np.ndarray:
    """Counts of the planes (planes, y, x), the bead in the middle."""
    cube = np.load(path)["cube"] if path.suffix == ".npz" else _tiff(path)
    row, column = np.unravel_index(cube.max(0).argmax(), cube.shape[1:])
    half = WINDOW // 2
    return cube[:, row - half : row + half + 1, column - half : column + half + 1]


def _tiff(path: Path) -> np.ndarray:
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        return np.array([np.array(plane) for plane in ImageSequence.Iterator(image)])


def main(source: str, folder: str) -> None:
    """Write ``beads.fits`` and ``beads.yaml`` to `folder`."""
    cube = planes(Path(source))
    travel_um = STEP_UM * (np.arange(len(cube)) - (len(cube) - 1) / 2)
    side_car = {
        "role": "defocus_ramp",
        "target": "fluorescent bead",
        "mag_j": None,
        "pixel_scale_mas": PIXEL_MAS,
        "spectrum": [{"wavelength_nm": WAVELENGTH_NM, "weight": 1.0}],
        "diversity": {"source": "none", "zernike": {}},
        "introduced_defocus_nm": (travel_um * defocus_nm_per_um(SINE)).round(4).tolist(),
    }
    Path(folder).mkdir(parents=True, exist_ok=True)
    fits.writeto(Path(folder) / "beads.fits", cube.astype(np.int32), overwrite=True)
    (Path(folder) / "beads.yaml").write_text(yaml.safe_dump(side_car, sort_keys=False))


if __name__ == "__main__":
    main(*sys.argv[1:])
