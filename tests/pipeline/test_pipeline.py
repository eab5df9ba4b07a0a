"""A run leaves whole products, results and quality control, whatever happens."""

import sys

import pytest
from helpers.fake_stages import COUNTS
from helpers.running import reasons, results, run, visible

from irlos_pipe.conventions.errors import InputDataError, IrlosError

PRODUCTS = ["01_ingest.h5", "02_calibrate.h5", "03_lift.h5"]


def test_a_run_leaves_products_results_quality_report_log_and_the_resolved_recipe(bench):
    run(bench)
    assert visible(bench) == [
        *PRODUCTS,
        "qc.json",
        "recipe.resolved.yaml",
        "report.html",
        "results.json",
        "run.log",
        "table.csv",
    ]


def test_a_second_run_does_nothing_and_changes_no_file(bench):
    first, _ = run(bench)
    before = {name: (bench.output / name).read_bytes() for name in visible(bench) if name != "run.log"}
    second, worked = run(bench)
    assert worked == [] and COUNTS["report"] == 1
    assert {name: (bench.output / name).read_bytes() for name in before} == before
    assert second.summary == first.summary == {"ingest": ["2 files"], "calibrate": ["mean 4 ADU"], "lift": []}
    assert set(reasons(bench).values()) == {"up to date"}
    (bench.output / "report.html").unlink()
    assert run(bench)[1] == [] and (bench.output / "report.html").is_file()


def test_a_failed_stage_keeps_the_products_before_it_and_says_so_in_the_results(bench):
    bench.make("calibrate.bad_data")
    with pytest.raises(InputDataError, match="HDU 1 is truncated"):
        run(bench)
    assert "01_ingest.h5" in visible(bench) and "02_calibrate.h5" not in visible(bench)
    assert results(bench)["status"] == "failed" and results(bench)["error"] == "cube.fits: HDU 1 is truncated"
    assert set(results(bench)["stages"]) == {"ingest"}
    (bench.data / "calibrate.bad_data").unlink()
    assert "calibrate.bad_data is gone" in reasons(bench)["ingest"]
    assert run(bench)[0].status == "ok"


def test_a_bug_is_reported_in_one_line_with_the_traceback_in_the_log(bench):
    bench.make("calibrate.crash")
    with pytest.raises(IrlosError) as caught:
        run(bench)
    log = bench.output / "run.log"
    assert str(caught.value) == f"unexpected ZeroDivisionError: a bug; the traceback is in {log}"
    assert "Traceback" in log.read_text() and "fake_stages.py" in log.read_text()
    assert caught.value.exit_code == 1


def test_a_report_that_cannot_be_built_costs_no_product(bench, monkeypatch):
    def fail(*_):
        raise KeyError("template")

    monkeypatch.setattr(sys.modules["irlos_pipe.report.build"], "write_report", fail)
    outcome, _ = run(bench)
    assert outcome.exit_code == 1 and outcome.report is None
    assert outcome.report_error.startswith(f"{bench.output / 'report.html'}: could not be built: KeyError")
    assert set(PRODUCTS) <= set(visible(bench)) and results(bench)["status"] == "ok"
