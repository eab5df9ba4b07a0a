"""Scores against a truth that is known by construction."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.report.score import score_run, score_text


def write_truth(folder: Path, **truths: dict[str, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, content in truths.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def scored(tmp_path: Path, *stages: str, **truths: dict[str, Any]) -> str:
    """Score of a made-up run; the names of the truths are those of their files."""
    folder = made_run.write_run(tmp_path / "run", made_run.products("ingest", *stages))
    return score_text(score_run(folder, write_truth(tmp_path / "truth", **truths)))


def row(text: str, first: str) -> list[str]:
    """Cells of the line that begins with `first`."""
    line = next(line for line in text.splitlines() if line.startswith(first))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def ramp_point(truth_nm: float, ncpa_nm: float = 30.0) -> dict[str, Any]:
    """Truth of a ramp recording whose time-averaged defocus is `truth_nm` beyond the NCPA."""
    return {"ncpa_nm": {"4": ncpa_nm}, "mean_zernike_nm": {"4": truth_nm + ncpa_nm}}


RAMP = {f"ramp__offset_{i:02d}": ramp_point(nm) for i, nm in enumerate(made_run.OFFSETS_NM)}


def shifted(**shifts_nm: float) -> dict[str, Any]:
    """Truth from which the calibration of the made-up run differs by these amounts (``z4=3``)."""
    truth = dict(made_run.NCPA_NM)
    for name, shift in shifts_nm.items():
        truth[name[1:]] = truth.get(name[1:], 0.0) - shift
    return {"mean_zernike_nm": truth}


@pytest.mark.parametrize(
    ("truths", "error", "of_defocus"),
    [
        ({"sky": shifted(z2=3.0, z4=-4.0, z5=12.0)}, "13.0", "-4.0"),  # modes add up in squares
        ({"sky": shifted(z31=50.0)}, "0.0", "+0.0"),  # of the reported modes alone
        ({"sky": shifted(z30=24.0)}, "24.0", "+0.0"),  # whether it was estimated or not
        ({"night__sky": shifted()}, "0.0", "+0.0"),  # the truth has the name of the recording …
        ({"sky": shifted(z4=5.0), "other__sky": shifted()}, "5.0", "+5.0"),  # … in full before a part of it
    ],
)
def test_the_error_is_that_of_the_reported_modes_against_the_truth_of_this_recording(
    tmp_path, truths, error, of_defocus
):
    cells = row(scored(tmp_path, "calibrate", **truths), "long_exposure")
    assert cells == ["long_exposure", f"{error} nm RMS", f"{of_defocus} nm", "2.0 s"]


def test_methods_run_beside_are_scored_too(tmp_path):
    truth = {"mean_zernike_nm": {"4": 31.5}}
    assert row(scored(tmp_path, "calibrate", sky=truth), "dip_avg") == [
        "dip_avg",
        "1.5 nm RMS",
        "+1.5 nm",
        "9.0 s",
    ]


def test_recordings_fitted_together_are_compared_with_their_mean_by_frames(tmp_path):
    ingest = made_run.ingest()
    ingest.results["inputs"] = [made_run.row("a", "calibration", 30), made_run.row("b", "calibration", 10)]
    folder = made_run.write_run(tmp_path / "run", [ingest, made_run.calibrate()])
    truth = write_truth(tmp_path / "truth", a=shifted(z4=8.0), b=shifted(z4=0.0))
    assert row(score_text(score_run(folder, truth)), "long_exposure")[1:3] == ["6.0 nm RMS", "+6.0 nm"]


def test_the_ramp_is_compared_with_the_defocus_that_was_there_without_the_ncpas(tmp_path):
    truths = {
        name: ramp_point(nm + 4.0, ncpa_nm=-70.0) for name, nm in zip(RAMP, made_run.OFFSETS_NM, strict=True)
    }
    text = scored(tmp_path, "lift", **truths)
    assert row(text, "frames against the true")[-1] == "3.0 nm RMS"


def test_means_of_recordings_lose_what_differs_from_frame_to_frame(tmp_path):
    lift = made_run.lift()
    lift.results["points"] = [
        made_run.point("offset_00", -100.0, -100.0 + error) for error in (2.0 + 5.0, 2.0 - 5.0)
    ]
    folder = made_run.write_run(tmp_path / "run", [made_run.ingest(), lift])
    text = score_text(score_run(folder, write_truth(tmp_path / "truth", **RAMP)))
    assert row(text, "means of recordings")[-1] == "2.0 nm RMS"
    assert row(text, "frames against the introduced")[-1] == "5.4 nm RMS"  # sqrt((49 + 9) / 2)


def test_calibration_and_ramp_are_scored_together_and_frames_without_estimate_left_out(tmp_path):
    lift = made_run.lift()
    lift.results["points"][0]["defocus_nm"] = None
    made = [made_run.ingest(), made_run.calibrate(), lift]
    truth = write_truth(tmp_path / "truth", sky=shifted(), **RAMP)
    text = score_text(score_run(made_run.write_run(tmp_path / "run", made), truth))
    assert row(text, "frames against the introduced")[-1] == "1.0 nm RMS"
    assert "calibration (sky)" in text and "ramp (3 recordings, 6 frames)" in text
    alone = score_text(score_run(tmp_path / "run", truth / "sky.json"))
    assert "calibration (sky)" in alone and "ramp" not in alone


def test_a_truth_without_mean_defocus_still_gives_the_error_against_the_introduced(tmp_path):
    text = scored(tmp_path, "lift", **{name: {"hidden": {}} for name in RAMP})
    assert row(text, "frames against the introduced")[-1] == "1.0 nm RMS"
    assert "true mean" not in text


def bad_truth(tmp_path: Path, content: str) -> Path:
    (tmp_path / "bad.json").write_text(content)
    return tmp_path / "bad.json"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path / "nowhere", "no such file or folder"),
        (lambda path: write_truth(path / "empty"), "no .*json in this folder"),
        (lambda path: write_truth(path / "truth", moon=shifted()), "no truth for sky; it holds moon"),
        (
            lambda path: write_truth(path / "truth", a__sky=shifted(), b__sky=shifted()),
            "several truth files: a__sky, b__sky",
        ),
        (lambda path: bad_truth(path, "{"), "bad.json: not a readable JSON file"),
        (lambda path: bad_truth(path, "[1]"), "bad.json: holds a list"),
    ],
)
def test_a_truth_that_cannot_be_used_is_reported_in_one_line(tmp_path, make, message):
    folder = made_run.write_run(tmp_path / "run", made_run.products("ingest", "calibrate"))
    with pytest.raises(InputDataError, match=message) as problem:
        score_run(folder, make(tmp_path))
    assert "\n" not in str(problem.value)


def test_a_run_without_estimates_has_nothing_to_compare(tmp_path):
    with pytest.raises(InputDataError, match="nothing to compare"):
        scored(tmp_path, sky=shifted())


def test_a_value_that_is_not_known_is_not_taken_for_zero(tmp_path):
    calibrate = made_run.calibrate()
    calibrate = replace(calibrate, results=calibrate.results | {"zernike_nm": made_run.NCPA_NM | {"4": None}})
    folder = made_run.write_run(tmp_path / "run", [made_run.ingest(), calibrate])
    text = score_text(score_run(folder, write_truth(tmp_path / "truth", sky=shifted())))
    assert "nan nm RMS" in row(text, "long_exposure")


def test_static_modes_and_their_pulls_are_scored_beside_the_mean_wavefront(tmp_path):
    """Errors of 3, -4 nm beside tip and tilt, quoted as 2 nm: pulls of 1.5 and 2 in two of two modes."""
    truth = shifted(z4=9.0) | {"ncpa_nm": {"2": 10.0, "3": -20.0, "4": 27.0, "5": 44.0}}
    cells = row(scored(tmp_path, "calibrate", sky=truth), "long_exposure")
    assert cells[-2:] == ["5.0 nm RMS", "1.77"]


def test_a_truth_without_the_mean_wavefront_is_named_as_such(tmp_path):
    with pytest.raises(InputDataError, match="the truth of sky has no mean_zernike_nm") as problem:
        scored(tmp_path, "calibrate", sky={"hidden": {}})
    assert "no truth for" not in str(problem.value)
