"""What commands print with --json keeps to the schema that is shipped, and says what the text says."""

import json
from functools import cache
from typing import Any

import jsonschema
import pytest
from conftest import invoke
from helpers import made_run
from helpers.result_schema import without_unknown_keys

from irlos_pipe.reference import COMMANDS


def printed(*call: str, code: int = 0) -> dict[str, Any]:
    """What a command prints, after a look at its form."""
    result = invoke(*call)
    assert result.exit_code == code, result.output
    content = json.loads(result.stdout, parse_constant=pytest.fail)  # NaN is no JSON
    assert [
        f"{error.json_path}: {error.message}" for error in _of(content["schema"]).iter_errors(content)
    ] == []
    return content


@cache
def _of(name: str) -> jsonschema.Draft202012Validator:
    """The part of the schema for one kind of output; no key beyond it is allowed here."""
    schema = without_unknown_keys(json.loads(COMMANDS.read_text()))
    assert {"$ref": f"#/$defs/{name}"} in schema["oneOf"]
    return jsonschema.Draft202012Validator(
        {"$ref": f"#/$defs/{name}", "$defs": schema["$defs"]},
    )


def test_status_of_a_run(bench):
    bench.run()
    found = printed("status", str(bench.output), "--json")
    assert found["schema"] == "irlos-status" and found["current"]
    assert [(one["product"], one["state"]) for one in found["products"]] == [
        ("01_ingest.h5", "up to date"), ("02_calibrate.h5", "up to date"), ("03_lift.h5", "up to date"),
    ]  # fmt: skip
    assert [(one["checks"], one["passed"]) for one in found["products"]] == [(0, 0), (1, 1), (0, 0)]


def test_status_of_an_outdated_run_says_why(bench):
    bench.run("--to", "calibrate")
    (bench.data / "c.dat").write_bytes(b"1")
    found = printed("status", str(bench.output), "--json")
    assert not found["current"]
    assert {one["state"] for one in found["products"]} == {"outdated"}
    assert "c.dat is new" in found["products"][0]["reason"]
    assert found["products"][2] | {"reason": ""} == {
        "product": "03_lift.h5", "state": "outdated", "reason": "", "checks": None, "passed": None,
        "finished": "",
    }  # fmt: skip


def test_status_of_numbered_versions(bench):
    bench.run("--numbered")
    bench.run("--numbered", "--set", "ingest.scale=2", "--to", "ingest")
    found = printed("status", str(bench.output), "--json")
    assert found["schema"] == "irlos-versions"
    assert [(one["version"], one["status"], one["latest"], one["changed"]) for one in found["versions"]] == [
        ("001", "ok", True, []),
        ("002", "incomplete", False, ["ingest.scale"]),
    ]


def test_show_of_a_product(bench):
    bench.run()
    found = printed("show", str(bench.output / "02_calibrate.h5"), "--json")
    assert (found["stage"], found["configuration"]["method"]) == ("calibrate", "dip_avg")
    assert [(one["name"], one["shape"], one["unit"]) for one in found["arrays"]] == [("mean", [], "ADU")]
    assert [(one["name"], one["passed"], one["low"], one["high"]) for one in found["checks"]] == [
        ("mean", True, 0, None)
    ]


def test_show_of_a_run(bench):
    bench.run()
    (bench.output / "03_lift.h5").write_bytes(b"torn")
    found = printed("show", str(bench.output), "--json")
    assert (found["schema"], found["status"]) == ("irlos-show-run", "ok")
    assert [(one["product"], one["arrays"], one["checks"]) for one in found["products"]] == [
        ("01_ingest.h5", 1, 0),
        ("02_calibrate.h5", 1, 1),
        ("03_lift.h5", None, None),
    ]
    assert "03_lift.h5" in found["products"][2]["problem"] and "results.json" in found["files"]


def test_validate_of_a_recipe_that_is_right(bench):
    found = printed("validate", str(bench.recipe), "--json")
    assert found["valid"] and found["problems"] == [] and found["stages"] == ["ingest", "calibrate", "lift"]
    assert found["inputs"] == {"cube": [str(bench.data)]}


def test_validate_lists_all_that_is_wrong_and_ends_with_the_same_code(bench):
    wrong = ("--set", "calibrate.jitter_sigma_mas=-1", "--set", "lift.nonsense=1")
    found = printed("validate", str(bench.recipe), *wrong, "--json", code=2)
    plain = invoke("validate", str(bench.recipe), *wrong)
    lines = [line.removeprefix("irlos: error: ") for line in plain.stderr.splitlines()]
    assert not found["valid"] and found["problems"] == lines and len(lines) == 2


def test_score_of_a_calibration(tmp_path):
    folder = made_run.write_run(tmp_path / "run", made_run.products("ingest", "calibrate"))
    truth = {"4": made_run.NCPA_NM["4"] + 5.0}
    (tmp_path / "sky.json").write_text(json.dumps({"mean_zernike_nm": made_run.NCPA_NM | truth}))
    found = printed("score", str(folder), "--truth", str(tmp_path / "sky.json"), "--json")
    first = found["calibration"]["methods"][0]
    assert (first["method"], found["ramp"]) == ("long_exposure", None)
    assert first["error_nm"] == pytest.approx(5.0) and first["defocus_error_nm"] == pytest.approx(-5.0)
    assert first["static_error_nm"] is None  # the truth has no static modes


def test_comparison_of_two_runs(bench):
    bench.run("--numbered")
    bench.run("--numbered", "--set", "ingest.scale=2")
    folders = (str(bench.output / name) for name in ("001", "latest"))
    found = printed("compare", *folders, "--json")
    assert [(one["name"], one["first"], one["second"]) for one in found["settings"]] == [
        ("ingest.scale", 1.0, 2.0)
    ]
    total = next(one for one in found["numbers"] if one["name"] == "total")
    assert (total["difference"], total["sigmas"]) == (total["first"], None)  # counts are doubled


def test_the_schemas_are_printed():
    for call, title in (
        (("--schema",), "results.json of irlos_pipe"),
        (("--schema", "commands"), "what commands of irlos_pipe print with --json"),
    ):
        assert json.loads(invoke("explain", *call).stdout)["title"] == title
