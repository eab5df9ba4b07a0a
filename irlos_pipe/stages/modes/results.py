"""Results of stage `modes`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults

if TYPE_CHECKING:
    from irlos_pipe.estimate.mode_law import ModeLaw


class LawRow(ResultsPart):
    """A fitted law std(i) = A exp(−B i) + C, i = 0 for Noll 2, see `estimate.mode_law.ModeLaw`.

    Attributes
    ----------
    A_nm, A_sigma_nm : float
        Amplitude A of the law, and its standard error [nm RMS].
    B, B_sigma : float
        Decay B per mode, and its standard error.
    C_nm, C_sigma_nm : float
        Plateau C, and its standard error [nm RMS].
    deviance_nu : float
        Deviance over what draws from the law would give; near 1 where it holds.
    plateau_noll : int or None
        Noll index from which the exponential is below a tenth of the plateau.
    """

    A_nm: Number = math.nan
    B: Number = math.nan
    C_nm: Number = math.nan
    A_sigma_nm: Number = math.nan
    B_sigma: Number = math.nan
    C_sigma_nm: Number = math.nan
    deviance_nu: Number = math.nan
    plateau_noll: int | None = None

    @classmethod
    def of(cls, law: ModeLaw) -> LawRow:
        """Return the parameters of a `law` with their errors."""
        a, b, c = law.sigma
        return cls(
            A_nm=law.a_nm,
            B=law.decay,
            C_nm=law.plateau_nm,
            A_sigma_nm=a,
            B_sigma=b,
            C_sigma_nm=c,
            deviance_nu=law.deviance_nu,
            plateau_noll=law.plateau_noll,
        )


class NumberScan(ResultsPart):
    """Fits with several numbers of modes; lists are over `highest_noll`.

    Attributes
    ----------
    cubes : int
        Cubes that the numbers were tried on.
    highest_noll : list of int
        Highest Noll index of each fit.
    held_out_chi2_nu, fitted_chi2_nu : list of float
        Reduced χ² of unseen frames, and of those fitted.
    excess, excess_sigma : list of float
        Held-out χ²/ν above the least, with its error.
    change_nm : list of float
        RMS difference of the reported modes from the estimate with the recommended number.
    halves_nm : list of float
        Error from the difference of the two halves of the frames.
    best, recommended : int
        Highest Noll index with the least χ², and the least one that is as good within the error.
    """

    cubes: int = 0
    highest_noll: list[int] = []
    held_out_chi2_nu: list[Number] = []
    excess: list[Number] = []
    excess_sigma: list[Number] = []
    fitted_chi2_nu: list[Number] = []
    change_nm: list[Number] = []
    halves_nm: list[Number] = []
    best: int = 0
    recommended: int = 0


class ModesResults(StageResults):
    """Strength of the modes and their number.

    Attributes
    ----------
    method : str
        How the modes of the cubes were estimated.
    cubes : int
        Cubes that the law was fitted to.
    draws : int
        Independent sets of NCPAs among the `cubes`.
    laws : dict of str to LawRow
        ``estimates`` as they are, and ``ncpas`` without the errors of the estimates.
    numbers : NumberScan or None
        None where no cube has frames enough.
    """

    stage: ClassVar[str] = "modes"
    method: str = ""
    cubes: int = 0
    draws: int = 0
    laws: dict[str, LawRow] = {}
    numbers: NumberScan | None = None
