"""`ncpa_drift`: the static wavefront is not static."""

from __future__ import annotations

from collections.abc import Sequence

from irlos_pipe.conventions.late import torch
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.planes import TimeEffect
from irlos_pipe.effects.zernike_table import ZernikeTable


class NcpaDrift(ZernikeTable, TimeEffect):
    """Aberrations that change in proportion to time: temperature, flexure, a turning derotator.

    The coefficients are the change from the first frame to the last, about the mean, so the NCPAs are
    those of the middle of the recording. In the mean image a drift is a blur of second order, whose
    derivative vanishes without it; it is single frames that show it, with its sign.

    Parameters
    ----------
    nolls : sequence of int
        Among the modes that are estimated.
    """

    name, table = "ncpa_drift", "zernike_nm"
    formula = "Φ(t) = Φ + (t − ½) Σ c_k Z_k, t from 0 at the first frame to 1 at the last"
    instrumental = False
    belongs_to = "moment"
    public = (Public(table, "Noll index: nm RMS from the first frame to the last", "zernike", -1e4, 1e4),)
    options = (Public("nolls", "Noll indices to estimate", "nolls"),)
    coefficient = Parameter("", "nm", 0.0, 0.0, 50.0, plausible=(-300.0, 300.0))
    sentence = "a drift of the wavefront of {size:.0f} nm RMS from the first frame to the last"
    look_alike = "tip_tilt_jitter and seeing_halo in the mean image; none in the frames"
    reference = "Vigan et al. 2022, A&A 660, A140"

    @classmethod
    def under(cls, conditions: Conditions, nolls: Sequence[int] = range(2, 12)) -> NcpaDrift:
        """See `Effect.under`: by default Noll 2 to 11."""
        return cls(nolls)

    def apply(
        self, values: torch.Tensor, modes_nm: torch.Tensor, nolls: tuple[int, ...], when: torch.Tensor
    ) -> torch.Tensor:
        """See `TimeEffect.apply`.

        Raises
        ------
        ValueError
            If a mode that drifts is not estimated.
        """
        missing = sorted(set(self.nolls) - set(nolls))
        if missing:
            raise ValueError(f"ncpa_drift of Noll {missing}: only modes that are estimated can drift")
        where = torch.zeros(len(self.nolls), len(nolls), dtype=torch.float64)
        for row, noll in enumerate(self.nolls):
            where[row, nolls.index(noll)] = 1
        return modes_nm + (when.double() - 0.5)[:, None] * (values @ where)
