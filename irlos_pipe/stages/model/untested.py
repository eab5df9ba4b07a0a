"""What recordings cannot tell of themselves, whatever their χ²/ν: it stands as declared."""

from collections.abc import Mapping, Sequence

BY_CUBES = (
    "the sign of the even modes, which is that of the declared diversity: {diversity}",
    "size and mode of the diversity: an error of theirs is taken for one of the NCPAs",
    "images transposed or turned by 180°: they fit as well, with other modes",
    "wavelength and pixel scale wrong by the same factor",
    "what is static in these frames alone, as petals of low wind: a cube of another night would differ",
    "a wrong flat or dark that is smooth",
    "a response of the detector that bends by some per cent: motion and modes imitate it",
)
ZERO_POINT = "zero point of the introduced defoci: an error of it is taken for defocus among the NCPAs"
MIRRORED = "images mirrored left to right or up and down: {why}"
FAINT_VANES = "the vanes are too faint in them"
LOOKED_AT_ELSEWHERE = "`calibrate` looks for it"
BY_RAMP = (
    "the zero point of the focus stage against the defocus among the NCPAs",
    "sign and orientation of diversity and offsets together: the slope tests one against the other",
    "wavelength and pixel scale wrong by the same factor",
)
NOT_TESTED = "Not tested"
CUBES_IN_SHORT = (
    f"{NOT_TESTED:16s}sign, size and mode of the diversity; images transposed or turned by 180°; wavelength "
    "and scale by one factor"
)


def untested_by_cubes(
    diversity_nm: Mapping[int, float], mirrored: str = "", introduced_nm: Sequence[float] = ()
) -> list[str]:
    """Return what cubes with a diversity `diversity_nm` cannot tell, one line each.

    `mirrored` says why it is not known whether images are mirrored; empty where it is. `introduced_nm`
    are the introduced defoci of several set-ups.
    """
    known = [f"Noll {noll} {nm:+g} nm" for noll, nm in sorted(diversity_nm.items())]
    planes = sorted(set(introduced_nm))
    if len(planes) > 1:
        known.append(f"defoci from {planes[0]:+g} to {planes[-1]:+g} nm")
    declared = ", ".join(known) or "none"
    more = [ZERO_POINT] if len(planes) > 1 else []
    more += [MIRRORED.format(why=mirrored)] if mirrored else []
    return [*(line.format(diversity=declared) for line in BY_CUBES), *more]
