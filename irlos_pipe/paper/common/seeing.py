"""The seeing on sky, which the paper states by MASS-DIMM, on the scale that the AO residual follows."""

from __future__ import annotations

from irlos_pipe.instrument.instrument import Instrument

MONITOR = "mass_dimm"


def on_spartas_scale(instrument: Instrument, seeing_arcsec: float) -> float:
    """Return the seeing on SPARTA's scale [arcsec].

    Parameters
    ----------
    instrument : Instrument
        With the relation of the two scales.
    seeing_arcsec : float
        By MASS-DIMM.
    """
    return float(instrument.seeing_scales[MONITOR].to_sparta(seeing_arcsec))
