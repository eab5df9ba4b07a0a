"""The command line: options, exit codes, and what goes to which stream."""

import json

import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner
from conftest import invoke, products
from filelock import FileLock
from helpers.paths import RECIPES
from helpers.sparta_files import counts, star, write_recorder

from irlos_pipe.commands.main import cli
from irlos_pipe.files import shipped
from irlos_pipe.product.storage import read_product
from irlos_pipe.reference import COMMANDS


def test_results_of_samples_say_so_on_the_terminal_and_in_the_results(bench, monkeypatch):
    monkeypatch.setattr(shipped, "shipped_folder", lambda kind: bench.data)
    result = bench.run()
    notice = "simulated sample: 'cube' came with the package"
    assert notice in result.stderr and f"NOTICE     {notice}" in result.stdout
    results = json.loads((bench.output / "results.json").read_text())
    assert results["samples"] == ["cube"] and results["notice"].startswith(notice)


def test_a_forgotten_input_is_an_error_in_one_line_and_a_recipe_is_valid_without_it(tmp_path):
    result = invoke("run", "ncpa_calibration", "--output", str(tmp_path / "out"))
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 2 and not (tmp_path / "out").exists()
    assert "input 'calibration' is not given; add --input calibration=PATH, or --samples" in line
    result = invoke("validate", "full_reduction")
    assert result.exit_code == 0 and result.stdout.endswith("; to be given: calibration, ramp\n")


LOW_WIND = ("--set", "model.effects=[low_wind_effect]", "--set", "instrument=bench")


@pytest.mark.parametrize(
    ("changes", "options", "code", "said"),
    [
        ({}, (), 0, ""),
        ({"mag_j": None}, (), 3, "offset_0: mag_j is missing"),
        ({"ramp_nm": (0.0, 100.0)}, (), 3, "ramp of 2 recordings: a ramp needs at least three estimates"),
        ({"last_px": 28}, (), 3, "offset_2: window differ from those of offset_0"),
        ({"role": "derotator"}, (), 3, "offset_0: its role is derotator; LIFT takes"),
        ({}, LOW_WIND, 2, "low_wind_effect for"),
    ],
    ids=["right", "magnitude", "points", "windows", "role", "petals"],
)
def test_what_a_run_refuses_is_told_without_running(tmp_path, changes, options, code, said):
    changes = dict(changes)
    ramp_nm, last_px = changes.pop("ramp_nm", (-100.0, 0.0, 100.0)), changes.pop("last_px", 32)
    write_recorder(tmp_path / "cal", counts(star(32, 32)))
    for number, nm in enumerate(ramp_nm):
        keys = {"role": "defocus_ramp", "introduced_defocus_nm": nm, "mag_j": 12.0} | changes
        side = last_px if nm == ramp_nm[-1] else 32
        write_recorder(
            tmp_path / "ramp" / f"offset_{number}", counts(star(side, side), 1, seed=number), keys=keys
        )
    given = ("--input", f"calibration={tmp_path / 'cal'}", "--input", f"ramp={tmp_path / 'ramp'}", *options)
    for command in (
        ("validate", "full_reduction"),
        ("run", "full_reduction", "--dry-run", "--output", "none"),
    ):
        result = invoke(*command, *given)
        assert (result.exit_code, said in result.stderr) == (code, True), result.stderr


def test_every_recipe_is_listed_and_can_be_copied():
    listed = invoke("recipes").stdout
    for name in shipped.shipped_names(shipped.RECIPES):
        assert f"\n{name} " in listed
        assert invoke("recipes", name).stdout == (RECIPES / f"{name}.yaml").read_text()
    result = invoke("recipes", "benhc")
    assert result.exit_code == 2 and "did you mean 'bench'?" in result.stderr


def test_a_run_ends_with_a_table_and_the_path_of_the_report_also_when_it_is_up_to_date(bench):
    first, second = bench.run(), bench.run()
    assert first.exit_code == second.exit_code == 0
    assert first.stdout.splitlines() == [
        "ingest     2 files",
        "calibrate  mean 4 ADU",
        "QC         1 of 1 checks passed",
        f"report     {bench.output / 'report.html'}",
    ]
    assert second.stdout == first.stdout
    assert "irlos: lift: no product yet" in first.stderr.splitlines()
    expected = [f"irlos: {name}: up to date" for name in ("ingest", "calibrate", "lift")]
    assert second.stderr.splitlines() == expected


def test_json_is_all_that_goes_to_stdout(bench):
    result = bench.run("--json")
    assert json.loads(result.stdout) == json.loads((bench.output / "results.json").read_text())


def test_quiet_says_nothing_when_all_is_well_and_verbose_what_the_stages_say(bench):
    result = bench.run("-q")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    assert "irlos: read 2 files" in bench.run("-v", "--force").stderr.splitlines()


def test_a_dry_run_prints_the_plan_as_text_or_json_and_touches_nothing(bench):
    result = bench.run("--dry-run", "--to", "calibrate")
    assert result.exit_code == 0 and not bench.output.exists()
    first, _, last = result.stdout.splitlines()
    assert first.split() == ["ingest", "run", "no", "product", "yet"] and "not selected" in last
    bench.run()
    plan = json.loads(bench.run("--dry-run", "--json", "--force", "--from", "lift").stdout)
    jsonschema.validate(plan, json.loads(COMMANDS.read_text()))
    assert [(step["stage"], step["action"]) for step in plan] == [
        ("ingest", "use as it is"), ("calibrate", "use as it is"), ("lift", "run"),
    ]  # fmt: skip


def test_the_seed_and_the_input_options_reach_the_stages(bench):
    bench.run("--seed", "5", "--input", f"cube={bench.data}")
    expected = np.random.default_rng(5).normal(size=3)
    assert np.array_equal(read_product(bench.output / "03_lift.h5").arrays["draws"].value, expected)


@pytest.mark.parametrize(
    ("behaviour", "code"),
    [
        ("calibrate.crash", 1),
        ("calibrate.disk_full", 1),
        ("calibrate.bad_data", 3),
        ("calibrate.missing_file", 3),
        ("calibrate.fail_qc", 4),
        ("calibrate.lose_exposure", 5),
        ("ingest.nothing", 64),
        ("calibrate.interrupt", 130),
    ],
)
def test_each_kind_of_failure_has_its_exit_code(bench, behaviour, code):
    bench.make(behaviour)
    result = bench.run("-q")
    assert result.exit_code == code
    assert len(result.stderr.splitlines()) == (code not in (4, 5))
    if code in (4, 5):
        status = json.loads((bench.output / "results.json").read_text())["status"]
        assert status == {4: "qc_failed", 5: "partial"}[code]
    whole = ["01_ingest.h5", "02_calibrate.h5", "03_lift.h5"]
    assert products(bench.output) == whole[: 3 * (code in (4, 5)) or behaviour.startswith("calibrate")]


def test_a_missing_cuda_device_is_reported(bench, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    result = bench.run("--device", "cuda")
    assert result.exit_code == 2 and "finds no CUDA device" in result.stderr


def test_a_folder_in_use_exits_with_75(bench):
    bench.output.mkdir()
    with FileLock(bench.output / ".lock"):
        result = bench.run()
    assert result.exit_code == 75 and "in use by another run" in result.stderr
    assert products(bench.output) == [] and bench.run().exit_code == 0


def test_an_output_that_cannot_be_made_exits_with_1_and_one_line(bench):
    (bench.folder / "file").touch()
    result = bench.run("--output", str(bench.folder / "file" / "out"))
    assert result.exit_code == 1 and len(result.stderr.splitlines()) == 1
    assert "cannot be written" in result.stderr


def test_status_says_what_is_up_to_date_and_why_the_rest_is_not_also_without_the_inputs(bench):
    bench.run()
    (bench.data / "a.dat").write_bytes(b"1")
    (bench.output / "03_lift.h5").unlink()
    lines = invoke("status", str(bench.output)).stdout.splitlines()
    assert lines[1].startswith("01_ingest.h5") and "outdated: input file cube/data/a.dat changed" in lines[1]
    assert lines[3].startswith("03_lift.h5") and "no product yet" in lines[3]
    bench.data.rename(bench.folder / "moved")
    lines = invoke("status", str(bench.output)).stdout.splitlines()
    assert len(lines) == 3 and "cannot be checked" in lines[1] and "no such file" in lines[1]


@pytest.mark.parametrize("command", ["status", "report", "show"])
def test_a_folder_without_a_run_is_reported(tmp_path, command):
    result = invoke(command, str(tmp_path))
    assert result.exit_code == 3 and "not the folder of a run" in result.stderr


def completed(typed: list[str]) -> list[str]:
    variables = {"COMP_WORDS": " ".join(["irlos", *typed]), "COMP_CWORD": str(len(typed))}
    result = CliRunner().invoke(cli, prog_name="irlos", env={"_IRLOS_COMPLETE": "bash_complete", **variables})
    assert not isinstance(result.exception, Exception)
    return result.stdout.split()


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("run ncpa", "ncpa_calibration"),
        ("run defocus_ramp --input cal", "calibration="),
        ("simulate on", "on_sky"),
    ],
)
def test_the_shell_completes_values(typed, expected):
    assert f"plain,{expected}" in completed(typed.split())


def test_the_shell_completes_arrays_of_the_product_that_was_typed_if_it_is_there(bench):
    bench.run()
    assert "plain,mean" in completed(["export", str(bench.output / "02_calibrate.h5"), "--array", "me"])
    assert completed(["export", "nothing.h5", "--array", "m"]) == []
