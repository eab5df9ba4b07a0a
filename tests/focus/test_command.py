"""`irlos focus` as a user calls it. Truth: the stage `lift`, which measures the same frames on its own."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from conftest import invoke
from helpers.paths import SAMPLES

from irlos_pipe.commands.focus import TOKEN
from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.replay import Replay
from irlos_pipe.focus.ring import RingWriter


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The samples reduced, every frame by itself."""
    folder = tmp_path_factory.mktemp("reduced") / "run"
    options = ["--set", "lift.singly=true", "--set", "lift.compare=false", "--jobs", "1", "-q"]
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


@pytest.mark.slow
def test_a_replay_gives_what_lift_gives_to_the_last_bit(run, tmp_path):
    result = invoke("focus", str(run), "--replay", str(run), "--output", str(tmp_path / "again"))
    assert result.exit_code == 0
    points = json.loads((run / "results.json").read_text())["stages"]["lift"]["points"]
    found = records(tmp_path / "again")
    assert f"{len(points)} records" in result.stdout
    for mine, theirs in zip(found, points, strict=True):
        assert (mine["defocus_nm"], mine["sigma_nm"]) == (theirs["defocus_nm"], theirs["sigma_photon_nm"])
        assert (mine["tip_nm"], mine["tilt_nm"]) == (theirs["zernike_nm"]["2"], theirs["zernike_nm"]["3"])
        assert mine["valid"] and not mine["commanded"]
    assert abs(found[0]["defocus_nm"] - points[0]["introduced_nm"]) < 10.0


@pytest.mark.slow
def test_what_cannot_be_is_said_in_one_line_with_its_exit_code(run, tmp_path):
    out = ("--output", tmp_path / "loop")
    text = tmp_path / "text"
    text.write_text("no frames at all")
    code, line = failure(run, "--ring", text, *out)
    assert code == 3 and f"{text}: not a ring of frames" in line
    RingWriter(tmp_path / "ring", (20, 24)).close()
    code, line = failure(run, "--ring", tmp_path / "ring", *out)
    assert code == 3 and "20x24 px" in line and "64x64 px" in line
    assert failure(run, "--folder", tmp_path / "none", *out)[0] == 3
    assert failure(run, "--replay", run, "--input", "calibratoin", *out)[0] == 3
    assert failure(tmp_path, "--replay", run, *out)[0] == 3
    assert "stable between 0 and 1.000" in failure(run, "--replay", run, "--gain", 1.5, *out)[1]
    assert (
        "needs a token"
        in failure(run, "--replay", run, "--page-port", 0, "--page-address", "0.0.0.0", *out)[1]
    )


@pytest.mark.slow
def test_frames_may_be_described_by_a_side_car(run, tmp_path):
    described = SAMPLES / "ramp" / "offset_00" / "acquisition.yaml"
    options = ["--acquisition", str(described), "--output", str(tmp_path / "loop"), "-q"]
    assert invoke("focus", str(run), "--replay", str(run), *options).exit_code == 0
    points = json.loads((run / "results.json").read_text())["stages"]["lift"]["points"]
    for mine, theirs in zip(records(tmp_path / "loop"), points, strict=True):
        assert mine["defocus_nm"] == pytest.approx(theirs["defocus_nm"], abs=1.0)
    assert "no such file" in failure(run, "--replay", run, "--acquisition", "none.yaml", *options[2:4])[1]


@pytest.mark.slow
def test_a_run_without_the_frames_of_a_loop_asks_for_their_description(run, tmp_path):
    only = tmp_path / "calibration"
    shutil.copytree(run, only)
    text = (only / "recipe.resolved.yaml").read_text().replace("input: ramp", "input: other")
    (only / "recipe.resolved.yaml").write_text(text)
    code, line = failure(only, "--replay", run, "--output", tmp_path / "loop")
    assert code == 2 and "--acquisition FILE" in line


@pytest.mark.parametrize("sources", [[], ["--ring", "a", "--folder", "b"]])
def test_one_source_is_asked_for(sources, tmp_path):
    result = invoke("focus", "run", "--output", str(tmp_path / "loop"), *sources)
    assert result.exit_code == 2
    assert "give one of --ring, --folder, --zeromq and --replay" in result.stderr


def test_the_help_teaches_by_examples_and_names_the_token():
    text = invoke("focus", "--help").stdout
    assert "irlos focus calibration --replay calibration" in text
    assert TOKEN in text


# -- as processes -----------------------------------------------------------------------------------


def started(run, ring, output) -> subprocess.Popen:
    program = [sys.executable, "-m", "irlos_pipe", "focus", run, "--ring", ring, "--output", output, "-q"]
    return subprocess.Popen([*map(str, program), "--reads", "2"], env={**os.environ, "OMP_NUM_THREADS": "1"})


def waited_for(output, count: int) -> list[dict]:
    until = time.monotonic() + 120
    while time.monotonic() < until:
        if (output / "focus.jsonl").exists() and len(found := records(output)) >= count:
            return found
        time.sleep(0.05)
    raise AssertionError(f"no {count} records")


@pytest.mark.slow
def test_killed_at_any_moment_the_loop_goes_on_where_it_was_and_nothing_is_lost(run, tmp_path):
    source = Replay(run, "ramp")
    frames = [read.image_e for _ in range(40) for read in source.poll(0.0)]
    ring, output = tmp_path / "ring", tmp_path / "loop"

    def write(first: int, last: int) -> None:
        writer = RingWriter(ring, (64, 64))  # a new writer every time, as after a kill of the other side
        for counter in range(first, last):
            writer.write(Read(counter, 1.7e9 + counter, frames[counter]))
        writer.close()

    write(0, 9)
    loop = started(run, ring, output)
    before = waited_for(output, 4)
    loop.kill()
    loop.wait()
    held = Mailbox(output / "command").read()
    assert (held.number, held.offset_nm) == (4, before[-1]["offset_nm"])
    write(9, 21)
    loop = started(run, ring, output)
    waited_for(output, 10)
    loop.send_signal(signal.SIGTERM)
    assert loop.wait(timeout=30) == 130
    found = records(output)
    assert found[:4] == before
    assert [one["sequence"] for one in found] == [*range(1, 12)]
    assert [one["exposure"] for one in found] == [*range(11)]  # the last one was cut short
    assert [one["reads"] for one in found] == [2] * 10 + [1]
    assert not any(one["reads_missing"] for one in found[:10])
