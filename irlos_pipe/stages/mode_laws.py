"""A fitted law of the modes in results.json."""

from __future__ import annotations

from irlos_pipe.estimate.mode_law import ModeLaw


def law_row(law: ModeLaw) -> dict[str, float]:
    """Parameters of a law with their errors."""
    sigmas = dict(zip(("A_sigma_nm", "B_sigma", "C_sigma_nm"), law.sigma, strict=True))
    return {
        "A_nm": law.a_nm,
        "B": law.decay,
        "C_nm": law.plateau_nm,
        **sigmas,
        "deviance_nu": law.deviance_nu,
        "plateau_noll": law.plateau_noll,
    }
