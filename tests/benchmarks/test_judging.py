"""How the suites judge what a user is told. Truth: outcomes written down by hand."""

import pytest

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR, SINGLE
from benchmarks.diagnose_suite.judging import (
    extra_names,
    first_is_wrong,
    is_first,
    is_in_set,
    is_in_some_set,
    is_named,
    is_right,
    is_untestable,
)
from benchmarks.misled.cases import CALIBRATION, DIAGNOSIS, NIGHT
from benchmarks.misled.suite import verdict

GHOST = {"flux_ratio": 0.003, "sep_mas": 100.0, "pa_deg": 30.0, "defocus_nm": 100.0}
AT_GHOST = {"flux_ratio": 0.003, "sep_mas": 110.0, "pa_deg": 31.0}
APART = {"flux_ratio": 0.01, "sep_mas": 200.0, "pa_deg": 210.0}
COMPANION = {"companion": APART}


def outcome(hidden, *names, kind=SINGLE, verdict=None, found=None, untestable=(), **truth) -> dict:
    """What a case came to: `names` are the names found, each with those it was not distinguished from."""
    steps = [
        {"effect": name, "indistinguishable": others, "parameters": found or {}, "sigma": {}}
        for name, *others in (one.split("|") for one in names)
    ]
    nothing = {"dirty": "mild" in truth, "sizes": {}, "known": {}, "mild": {}}
    return {
        "case": f"{kind}.{hidden}.{'+'.join(names)}",
        "truth": nothing | {"kind": kind, "effects": hidden.split()} | truth,
        "diagnosis": {
            "verdict": verdict or ("effect" if names else "none"),
            "steps": steps,
            "untestable": [*untestable],
            "mdb": {},
        },
    }


def dirty(hidden, *names, **more) -> dict:
    """The same where scale and ghost are a little wrong."""
    return outcome(hidden, *names, **{"mild": {"plate_scale": {"fraction": 0.005}, "ghost": GHOST}} | more)


@pytest.mark.parametrize(
    ("one", "true", "false"),
    [
        (outcome("companion", "vibration"), [extra_names], [is_first, is_right]),
        (outcome("companion", "vibration|companion|phase_bump"), [is_in_set], [is_first]),
        (outcome("companion", "vibration|companion|phase_bump|spectrum"), [], [is_in_set]),
        (outcome("companion", "vibration", "companion"), [is_named], [is_in_set, is_right]),
        (outcome("companion", verdict="unknown"), [], [is_in_set]),
        (outcome("companion", "companion", "vibration"), [is_first, extra_names], [is_right]),
        (dirty("companion", "companion_2", known=COMPANION, found=APART), [is_first], [first_is_wrong]),
        # a mild error that is there is no wrong name
        (dirty("vibration", "plate_scale", "vibration"), [is_named, is_right], [is_first, first_is_wrong]),
        (dirty("vibration", "phase_bump", "vibration"), [is_named, first_is_wrong], [is_right]),
        (dirty("plate_scale", "spectrum|plate_scale"), [is_in_some_set], [is_named, first_is_wrong]),
        # a second image is right where the ghost is, and a hidden one is not named by the ghost
        (dirty("vibration", "companion", found=AT_GHOST), [], [first_is_wrong]),
        (dirty("companion", "companion", known=COMPANION, found=AT_GHOST), [], [is_named, first_is_wrong]),
        (dirty("ghost", "companion", mild={}, known={"ghost": GHOST}, found=GHOST), [], [is_named]),
        (dirty("ghost", "companion", mild={}, known={"ghost": GHOST}, found=GHOST), [], [first_is_wrong]),
        (dirty("", kind=CLEAN, verdict="unknown"), [is_right], []),
        (dirty("scratch", "phase_bump", kind=OUTSIDE), [], [is_right]),
        (dirty("vibration", "plate_scale", kind=PAIR), [], [is_right]),
        # what the data cannot show is untestable beside right names only
        (dirty("diversity_error", "plate_scale", untestable=["diversity_error"]), [is_untestable], []),
        (dirty("diversity_error", "phase_bump", untestable=["diversity_error"]), [], [is_untestable]),
    ],
    ids=lambda one: one["case"] if isinstance(one, dict) else "",
)  # fmt: skip
def test_a_diagnosis_is_judged_by_what_it_names_and_where(one, true, false):
    assert all(judge(one) for judge in true)
    assert not any(judge(one) for judge in false)


# Plausible but wrong inputs.


PASSED = {"kind": CALIBRATION, "family": "x", "right": False, "cause": "", "accused": [], "warned": []}
PASSED |= {"sigmas": 1.0, "untested": []}
WRONG = {"sigmas": 9.0}
FOUND = {"steps": [], "mdb": {}, "untestable": [], "grade": "none", "verdict": "none"}
FOUND |= {"zernike_nm": {"after": {"4": 10.0}}, "sigma_nm": {"4": 1.0}}


@pytest.mark.parametrize(
    ("change", "column"),
    [
        ({}, "passed"),
        (WRONG, "misled"),
        ({"accused": ["slope"]} | WRONG, "accused"),
        ({"warned": ["spectrum taken from the profile"]} | WRONG, "misled"),
        ({"warned": ["exposure_s is odd"]} | WRONG, "warned only"),
        ({"cause": "transposed", "untested": ["images transposed"]} | WRONG, "said before"),
        ({"cause": "transposed"} | WRONG, "misled"),
        ({"kind": NIGHT, "accused": ["night"]} | WRONG, "misled"),
        ({"kind": NIGHT, "accused": ["night"]}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "named"}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "misnamed"}, "misled"),
        ({"kind": DIAGNOSIS, "finding": "misnamed", "right": True}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "none"}, "misled"),
        ({"kind": DIAGNOSIS, "finding": "none", "right": True}, "passed"),
        ({"kind": DIAGNOSIS, "finding": "too small"}, "passed"),
    ],
)
def test_an_outcome_is_counted_once_as_what_a_user_is_told(change, column):
    assert verdict(PASSED | change) == column
