"""Noll indices: tip and tilt, defocus, and the reported modes, the 29 modal offsets that SPARTA takes."""

TIP_TILT = (2, 3)  # the position of the star, which says nothing about the optics
DEFOCUS = 4
HIGHEST_REPORTED_NOLL = 30
REPORTED_NOLLS = tuple(range(2, HIGHEST_REPORTED_NOLL + 1))
CORRECTED_NOLLS = REPORTED_NOLLS[len(TIP_TILT) :]  # tip and tilt are the fast loop's
HIGHEST_NOLL = 231  # that may be estimated: memory and time grow with the number of modes
REPORTED_TEXT = f"Noll {REPORTED_NOLLS[0]}–{HIGHEST_REPORTED_NOLL}"
