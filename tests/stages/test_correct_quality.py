"""A Strehl ratio above what the AO residual leaves fails.

Truth: the extended Maréchal approximation, exp(−(2πσ/λ)²), of the residual at the seeing that was told.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.product.product import Product
from irlos_pipe.stages.correct import _checks

WAVELENGTH_NM, SEEING = 1600.0, 0.5
INSTRUMENT = load_instrument("irlos")
LIMIT = float(np.exp(-((2 * np.pi * (104.27 * SEEING + 58.6) / WAVELENGTH_NM) ** 2)))


def checks(strehl: float, source: str = "side-car", effects: dict | None = None) -> list:
    acquisition = SimpleNamespace(
        sources={"seeing_arcsec": source}, seeing_arcsec=SEEING, spectrum=((WAVELENGTH_NM, 1.0),)
    )
    calibrate = Product("calibrate", {}, {"effects": effects or {}})
    ctx = SimpleNamespace(instrument=INSTRUMENT, products={"calibrate": calibrate})
    return _checks(ctx, SimpleNamespace(acquisition=acquisition), SimpleNamespace(strehl_after=strehl))


@pytest.mark.parametrize(("strehl", "passed"), [(1.0, False), (LIMIT + 0.01, False), (LIMIT - 0.01, True)])
def test_a_strehl_ratio_above_what_the_residual_leaves_fails(strehl, passed):
    (check,) = checks(strehl)
    assert check.passed == passed and check.high == pytest.approx(LIMIT, rel=1e-6)
