"""Make FITS cubes with side-cars from stacks of a bead behind a deformable mirror, one per voltage.

``python mirror_bead_to_fits.py STACKS OUTPUT_FOLDER``; STACKS is a FITS file with the axes (volts, planes,
y, x). Source of the data: github.com/husicj/poisson-reconstruction, folder sample_data, MIT.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml
from astropy.io import fits

from irlos_pipe.optics.defocus import defocus_nm_per_um

SINE, INDEX, STEP_UM, WAVELENGTH_NM, PIXEL_MAS = 1.2 / 1.333, 1.333, 1.0, 532.0, 16.5012
WINDOW = 96  # about the middle


def main(source: str, folder: str) -> None:
    """Write ``volt_1.fits``, ``volt_1.yaml`` and so on to `folder`."""
    stacks = fits.getdata(source)
    planes, rows, columns = stacks.shape[1:]
    travel_um = STEP_UM * (np.arange(planes) - (planes - 1) / 2)
    side_car = {
        "role": "ncpa_calibration",
        "target": "fluorescent bead",
        "mag_j": None,
        "pixel_scale_mas": PIXEL_MAS,
        "spectrum": [{"wavelength_nm": WAVELENGTH_NM, "weight": 1.0}],
        "diversity": {"source": "none", "zernike": {}},
        "introduced_defocus_nm": (travel_um * defocus_nm_per_um(SINE, INDEX)).round(3).tolist(),
        "detector": {"e_per_adu": 0.46, "read_noise_e": 8.7},
    }
    top, left = (rows - WINDOW) // 2, (columns - WINDOW) // 2
    Path(folder).mkdir(parents=True, exist_ok=True)
    for number, stack in enumerate(stacks, start=1):
        cube = stack[:, top : top + WINDOW, left : left + WINDOW].astype(np.int32)
        fits.writeto(Path(folder) / f"volt_{number}.fits", cube, overwrite=True)
        (Path(folder) / f"volt_{number}.yaml").write_text(yaml.safe_dump(side_car, sort_keys=False))


if __name__ == "__main__":
    main(*sys.argv[1:])
