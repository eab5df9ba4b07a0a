"""Strehl budget; truth: Maréchal's law, the Gaussian blur of an OTF, and HCIPy's images."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.optics_cases import NARROW_H, SCALE_MAS, ncpa_nm, settings, vector
from helpers.reference_psf import reference

from irlos_pipe.estimate.correction import ALL, strehl_budget

WINDOW, NOLLS = (41, 41), tuple(range(4, 16))
WAVELENGTH_NM = NARROW_H[0][0]


def budget(effects=(), **modes_nm: dict[int, float]):
    parts = {name: vector(one, NOLLS)[0].numpy() for name, one in modes_nm.items()}
    return {
        one.name: one
        for one in strehl_budget(settings(WINDOW), NOLLS, parts, {one.name: one for one in effects})
    }


def test_small_aberrations_follow_marechal_and_multiply():
    found = budget(low={5: 25.0}, high={14: 20.0})
    for name, nm in (("low", 25.0), ("high", 20.0)):
        marechal = np.exp(-((2 * np.pi * nm / WAVELENGTH_NM) ** 2))
        assert found[name].alone == pytest.approx(marechal, abs=2e-3)
        assert found[name].wfe_nm == pytest.approx(nm)
    assert found[ALL].alone == pytest.approx(found["low"].alone * found["high"].alone, abs=1e-3)
    assert found["low"].without == pytest.approx(found["high"].alone)


@pytest.mark.slow
def test_the_strehl_ratio_is_that_of_hcipys_images():
    imager, modes = reference(512), {n: nm for n, nm in ncpa_nm(5, 15, 90.0).items() if n in NOLLS}
    images = [imager.image(opd, WAVELENGTH_NM, WINDOW, SCALE_MAS) for opd in (imager.opd_nm(modes), 0.0)]
    true = images[0].max() / images[1].max()
    assert budget(modes=modes)[ALL].alone == pytest.approx(true, abs=1e-3)
