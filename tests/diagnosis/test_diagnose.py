"""Diagnoses of cubes whose images HCIPy made (independent code), with something hidden in them."""

import re

import numpy as np
import pytest
import torch
from helpers.diagnose_cases import (
    CASE,
    COMPANION,
    FURTHER,
    GHOST,
    PUPIL,
    SPOT_M,
    SPOT_RADIUS_M,
    TRUE_NM,
    diagnosis_of,
)

from irlos_pipe.diagnosis.conclude import _amplitude
from irlos_pipe.diagnosis.verdict import sentence
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.optics.psf import PsfModel

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("diagnoses")]  # each is made once


def error_nm(diagnosis, which: int) -> float:
    """Error of the NCPAs before (0) or after (1)."""
    true = np.array([TRUE_NM[noll] for noll in diagnosis.nolls])
    return float(np.linalg.norm(diagnosis.modes_nm[which] - true))


def assert_sized(step, second: dict[str, float]) -> None:
    """Flux ratio and place are those of a second image, within four standard errors."""
    x, y = (9.7 * second[key] for key in ("x_px", "y_px"))
    true = {"sep_mas": np.hypot(x, y), "pa_deg": np.rad2deg(np.arctan2(y, x)) % 360}
    for key, value in {"flux_ratio": second["flux_ratio"], **true}.items():
        assert step.public[key] == pytest.approx(value, abs=4 * step.sigma[key] + 1e-3 * value), key


def test_a_clean_cube_has_nothing_missing():
    diagnosis = diagnosis_of("plain")
    assert diagnosis.verdict == "none"
    assert abs(diagnosis.excess_sigma[0]) < 4
    assert diagnosis.gap.before < 1.2 * diagnosis.gap.floor


def test_what_the_free_modes_absorb_is_called_untestable_not_absent():
    diagnosis = diagnosis_of("plain")
    assert "diversity_error" in diagnosis.untestable  # Noll 6 is estimated
    assert "atmospheric_dispersion" in diagnosis.untestable  # one wavelength
    assert not set(diagnosis.mdb) & set(diagnosis.untestable)


def test_a_second_source_is_named_with_its_size():
    (step,) = diagnosis_of("companion").steps
    assert step.name == "companion"
    assert_sized(step, COMPANION)


def test_a_second_image_as_sharp_as_the_star_may_as_well_be_a_ghost_of_the_optics():
    (step,) = diagnosis_of("companion").steps
    assert [one.name for one in step.alternatives] == ["ghost"]
    assert "companion: ghost" in sentence(diagnosis_of("companion"))


def test_one_that_is_out_of_focus_is_a_ghost():
    (step,) = diagnosis_of("ghost").steps
    assert (step.name, step.alternatives) == ("ghost", [])
    assert_sized(step, GHOST)
    assert step.public["defocus_nm"] == pytest.approx(80.0, abs=4 * step.sigma["defocus_nm"])


def test_facts_of_the_pupil_that_were_told_wrong_are_named_with_what_the_data_want():
    diagnosis = diagnosis_of("pupil")
    found = {key: (value, s.sigma[key]) for s in diagnosis.steps for key, value in s.public.items()}
    assert {step.name for step in diagnosis.steps} == {"pupil_geometry", "pupil_misregistration"}
    for key, true in PUPIL.items():
        assert found[key][0] == pytest.approx(true, abs=4 * found[key][1]), key
    assert re.search(r"obscuration of 1\.22\d* ± 0\.00\d+ m instead of 1\.12 m", sentence(diagnosis))
    assert re.search(r"vanes turned by \+\d\.\d+ ± 0\.\d+° against the profile", sentence(diagnosis))


def test_a_third_source_is_a_second_companion():
    first, second = diagnosis_of("two").steps
    assert (first.label, second.label) == ("companion", "companion_2")
    assert_sized(first, COMPANION)
    assert_sized(second, FURTHER)


def test_the_ncpas_improve_and_the_held_out_gap_closes_with_the_name():
    diagnosis = diagnosis_of("companion")
    assert error_nm(diagnosis, 1) < error_nm(diagnosis, 0) / 5
    assert diagnosis.gap.shrink > 0.95


def test_every_effect_of_the_catalogue_is_said_to_be_named_or_why_not():
    found = {one.effect: one for one in diagnosis_of("companion").tried}
    assert [*found] == [*CATALOGUE]
    assert found["companion"].outcome == "named"
    assert found["ghost"].outcome == "fitted"
    assert found["diversity_error"].outcome == "absorbed"
    assert found["vibration"].significance < 5 and found["vibration"].outcome in ("scored", "fitted")
    assert all(one.reason for one in found.values() if one.outcome != "named")


def test_a_rival_has_what_data_that_no_fit_has_seen_say_of_it():
    first, *others = diagnosis_of("companion").steps[0].ranking
    assert (first.name, first.held_out_z) == ("companion", 0)
    assert [one.name for one in others] == ["ghost"]  # as sharp, it makes the same image
    assert abs(others[0].held_out_z) < 3


def test_an_opaque_disc_is_a_spot_where_it_is():
    found = diagnosis_of("spot").steps[0]
    assert found.name == "pupil_spot"
    assert [found.public[key] for key in ("x_m", "y_m")] == pytest.approx(SPOT_M, abs=0.05)
    assert found.public["radius_m"] == pytest.approx(SPOT_RADIUS_M, rel=0.1)  # of a soft edge
    assert found.public["opacity"] > 0.95


def test_beside_a_spot_the_pupil_is_as_adjusted_facts_have_it_which_make_up_for_its_soft_edge():
    """Facts take up what a soft edge misses of a disc, and move less light than it does; that is all."""
    diagnosis, psf = diagnosis_of("spot"), PsfModel(CASE, (2, 3), dtype=torch.float64)

    def change(effects: list) -> np.ndarray:
        """Of the amplitude in the pupil, (n, n)."""
        none, model = torch.zeros(0, dtype=torch.float64), ImageModel(psf, effects)
        return _amplitude(model, none) - _amplitude(ImageModel(psf, []), none)

    added, spot = diagnosis.pictures.added_amplitude, change([diagnosis.steps[0].effect])
    facts, elsewhere = change([one.effect for one in diagnosis.adjusted]), np.abs(spot) < 1e-6
    assert added.min() < -0.9
    assert np.mean(elsewhere) > 0.95
    assert added[elsewhere] == pytest.approx(facts[elsewhere], abs=1e-6)
    (x, y), (x_m, y_m) = (axis * psf.grids.pupil.radius_m for axis in psf.grids.pupil.xy), SPOT_M
    dark = np.hypot(x - x_m, y - y_m) < SPOT_RADIUS_M
    assert np.sum(facts**2) < np.sum((spot + dark) ** 2)


@pytest.mark.long
def test_a_scratch_which_the_catalogue_lacks_gets_no_name():
    diagnosis = diagnosis_of("scratch")
    assert diagnosis.verdict == "unknown"
    assert diagnosis.steps == []
    assert diagnosis.why_unknown
