"""`irlos focus` as a user calls it. Truth: the stage `lift`, which measures the same frames on its own."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import invoke, without_report
from helpers.paths import SAMPLES

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.focus.calibration import CalibrationRequest
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.recordings import Replay
from irlos_pipe.focus.ring import RingWriter

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("focus")]  # its fixtures take long


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The samples reduced, every frame by itself."""
    folder = tmp_path_factory.mktemp("reduced") / "run"
    options = ["--set", "lift.singly=true", "--set", "lift.compare=false", "--jobs", "1", "-q"]
    with without_report():
        result = invoke("run", "defocus_ramp", "--samples", "--output", str(folder), *options)
    assert result.exit_code in (0, 4), result.stderr
    return folder


def failure(*arguments: object) -> tuple[int, str]:
    result = invoke("focus", *map(str, arguments))
    lines = result.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("irlos: error: "), result.stderr
    return result.exit_code, lines[0]


def records(folder) -> list[dict]:
    content = [json.loads(line) for line in (folder / "focus.jsonl").read_text().splitlines()]
    return [one for one in content if "sequence" in one]


def test_a_replay_gives_what_lift_gives_to_the_last_bit(run, tmp_path):
    result = invoke("focus", str(run), "--replay", str(run), "--output", str(tmp_path / "again"))
    assert result.exit_code == 0
    points = json.loads((run / "results.json").read_text())["stages"]["lift"]["points"]
    found = records(tmp_path / "again")
    assert f"{len(points)} records" in result.stdout and "simulated sample: 'ramp'" in result.stdout
    for mine, theirs in zip(found, points, strict=True):
        assert [mine[key] for key in ("defocus_nm", "sigma_nm", "sigma_photon_nm")] == [
            theirs[key] for key in ("defocus_nm", "sigma_nm", "sigma_photon_nm")
        ]
        assert (mine["tip_nm"], mine["tilt_nm"]) == (theirs["zernike_nm"]["2"], theirs["zernike_nm"]["3"])
        assert mine["valid"] and not mine["commanded"]
    assert abs(found[0]["defocus_nm"] - points[0]["introduced_nm"]) < 10.0


def test_what_cannot_be_is_said_in_one_line_with_its_exit_code(run, tmp_path):
    (tmp_path / "text").write_text("no frames at all")
    RingWriter(tmp_path / "ring", (20, 24)).close()
    replay = ("--replay", run)
    for arguments, code, words in (
        ((run, "--ring", tmp_path / "text"), 3, f"{tmp_path}/text: not a ring of frames"),
        ((run, "--ring", tmp_path / "none", "--wait", 0.1), 3, "cannot be read as a ring of frames"),
        ((run, "--ring", tmp_path / "ring"), 3, "20x24 px, and the calibration"),
        ((run, "--folder", tmp_path / "none"), 3, "no such folder"),
        ((run, *replay, "--input", "calibratoin"), 3, "no recordings of input 'calibratoin'"),
        ((run, *replay, "--acquisition", "none.yaml"), 3, "no such file"),
        ((tmp_path, *replay), 3, "not the folder of a run"),
        ((run, *replay, "--gain", 1.5), 2, "stable between 0 and 1.000"),
        ((run, *replay, "--wait", "nan"), 2, "--wait nan: give a finite number"),
        ((run, *replay, "--page-port", 0, "--page-address", "0.0.0.0"), 2, "needs a token"),
    ):
        found, line = failure(*arguments, "--output", tmp_path / "loop")
        assert found == code and words in line


def test_frames_may_be_described_by_a_side_car(run, tmp_path):
    described = SAMPLES / "ramp" / "offset_00" / "acquisition.yaml"
    options = ["--acquisition", str(described), "--output", str(tmp_path / "loop"), "-q"]
    assert invoke("focus", str(run), "--replay", str(run), *options).exit_code == 0
    points = json.loads((run / "results.json").read_text())["stages"]["lift"]["points"]
    for mine, theirs in zip(records(tmp_path / "loop"), points, strict=True):
        assert mine["defocus_nm"] == pytest.approx(theirs["defocus_nm"], abs=1.0)


@pytest.mark.parametrize("angle_deg", [0.0, 360.0, 60.0])
def test_frames_of_another_derotator_angle_than_the_calibration_are_named(run, tmp_path, angle_deg):
    described = (SAMPLES / "ramp" / "offset_00" / "acquisition.yaml").read_text()
    kept = [line for line in described.splitlines() if not line.startswith("derotator_angle_deg")]
    (tmp_path / "turned.yaml").write_text("\n".join([*kept, f"derotator_angle_deg: {angle_deg}"]))
    options = ["--acquisition", str(tmp_path / "turned.yaml"), "--output", str(tmp_path / "loop")]
    told = invoke("focus", str(run), "--replay", str(run), *options).stdout
    named = "taken at 60° of the derotator, the calibration at 0°"
    assert (named in told) == (angle_deg == 60.0)


def test_recordings_of_a_reduced_run_need_not_be_there_any_more(run, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(run, moved)
    recipe = moved / "recipe.resolved.yaml"
    recipe.write_text(recipe.read_text().replace(str(SAMPLES), str(tmp_path / "nowhere")))
    result = invoke("focus", str(moved), "--replay", str(moved), "--output", str(tmp_path / "loop"), "-q")
    assert result.exit_code == 0, result.stderr
    points = json.loads((run / "results.json").read_text())["stages"]["lift"]["points"]
    assert [one["defocus_nm"] for one in records(tmp_path / "loop")] == [one["defocus_nm"] for one in points]


@pytest.fixture
def doubtful(run, tmp_path):
    """The run with QC that has failed."""
    folder = tmp_path / "doubtful"
    shutil.copytree(run, folder)
    results = json.loads((folder / "results.json").read_text())
    (folder / "results.json").write_text(json.dumps(results | {"status": "qc_failed"}))
    quality = json.loads((folder / "qc.json").read_text())
    quality["checks"][0] |= {"passed": False, "name": "chi2 of the frames"}
    (folder / "qc.json").write_text(json.dumps(quality))
    return folder


def test_a_calibration_whose_qc_has_failed_is_taken_only_when_asked_for(run, doubtful, tmp_path):
    replay = ("--replay", str(run), "--output", str(tmp_path / "loop"))
    code, line = failure(doubtful, *replay)
    assert code == 3
    assert re.search(r"doubtful: its QC has failed \('chi2 of the frames'.*--despite-qc", line)
    assert invoke("focus", str(doubtful), *replay, "--despite-qc", "-q").exit_code == 0


@pytest.mark.parametrize("turn", [np.flipud, np.fliplr, np.transpose, np.rot90])
def test_samples_read_out_in_another_orientation_are_not_valid(run, turn):
    sensor = CalibrationRequest(run, despite_qc=True).load().sensor
    frames = [read.image_e for _ in range(5) for read in Replay(run, "ramp").poll(0.0)]
    assert all(sensor.measurement(frame).valid for frame in frames)
    assert all("mirrored" in sensor.measurement(turn(frame)).reasons for frame in frames)


def test_a_calibration_with_frames_of_a_2x2_mode_asks_for_those_of_the_full_pupil(run, monkeypatch):
    real = CalibrationRequest._frames

    def two_by_two(*arguments):
        recording, *rest = real(*arguments)
        return replace(recording, acquisition=replace(recording.acquisition, lenslets=2)), *rest

    monkeypatch.setattr(CalibrationRequest, "_frames", two_by_two)
    with pytest.raises(ConfigurationError, match=r"2x2 mode.*full pupil.*--acquisition FILE"):
        CalibrationRequest(run, despite_qc=True).load()


# -- as processes -----------------------------------------------------------------------------------


def started(run, ring, output) -> subprocess.Popen:
    program = [sys.executable, "-m", "irlos_pipe", "focus", run, "--ring", ring, "--output", output]
    return subprocess.Popen(
        [*map(str, program), "--reads", "2", "--despite-qc"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def write(ring, counters: range, frames) -> None:
    writer = RingWriter(ring, (64, 64))  # a new writer every time, as after a kill of the other side
    for counter in counters:
        writer.write(Read(counter, 1.7e9 + counter, frames[counter % len(frames)]))
    writer.close()


def waited_for(output, count: int) -> list[dict]:
    until = time.monotonic() + 120
    while time.monotonic() < until:
        if (output / "focus.jsonl").exists() and len(found := records(output)) >= count:
            return found
        time.sleep(0.05)
    raise AssertionError(f"no {count} records")


def test_killed_at_any_moment_the_loop_goes_on_where_it_was_and_nothing_is_lost(run, tmp_path):
    source = Replay(run, "ramp")
    frames = [read.image_e for _ in range(40) for read in source.poll(0.0)]
    ring, output = tmp_path / "ring", tmp_path / "loop"

    write(ring, range(9), frames)
    loop = started(run, ring, output)
    before = waited_for(output, 4)
    loop.kill()
    loop.wait()
    held = Mailbox(output / "command").read()
    assert (held.number, held.offset_nm) == (4, before[-1]["offset_nm"])
    write(ring, range(9, 21), frames)
    loop = started(run, ring, output)
    waited_for(output, 10)
    loop.send_signal(signal.SIGTERM)
    told, errors = loop.communicate(timeout=30)
    assert (loop.returncode, errors) == (0, "")
    assert told.splitlines()[-2:] == ["stopped", f"7 records in {output}"]
    found = records(output)
    assert found[:4] == before
    assert [one["sequence"] for one in found] == [*range(1, 12)]
    assert [one["exposure"] for one in found] == [*range(11)]  # the last one was cut short
    assert [one["reads"] for one in found] == [2] * 10 + [1]
    assert not any(one["reads_missing"] for one in found[:10])


def test_the_loop_outlives_its_ring_and_an_interrupt_ends_it_as_the_contract_says(run, tmp_path):
    frames = [read.image_e for read in Replay(run, "ramp").poll(0.0)]
    ring, output = tmp_path / "ring", tmp_path / "loop"

    loop = started(run, ring, output)
    assert loop.stdout is not None
    assert loop.stdout.readline() == f"waiting 60 s for the ring {ring}\n"
    write(ring, range(100, 104), frames)
    waited_for(output, 2)
    os.truncate(ring, 0)
    time.sleep(1.0)
    ring.unlink()
    write(ring, range(4), frames)
    found = waited_for(output, 4)
    assert [one["exposure"] for one in found] == [50, 51, 0, 1]
    loop.send_signal(signal.SIGINT)
    told, errors = loop.communicate(timeout=30)
    assert (loop.returncode, errors) == (130, "")
    lines = told.splitlines()
    assert any("waiting for it" in line for line in lines) and any("made anew" in line for line in lines)
    assert lines[-2:] == ["stopped", f"4 records in {output}"]
