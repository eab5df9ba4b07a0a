"""What a run would do, and the reason it gives."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.running import STAGES, reasons, results, run

from irlos_pipe.conventions.errors import ConfigurationError, NothingToDo
from irlos_pipe.pipeline import Selection, plan_run
from irlos_pipe.product.storage import read_product, write_product
from irlos_pipe.recipe import load_recipe


def test_a_changed_setting_redoes_its_stage_only_and_says_from_what_to_what(bench):
    run(bench)
    assert reasons(bench, "calibrate.method=dip_global") == {
        "ingest": "up to date",
        "calibrate": "calibrate.method changed dip_avg -> dip_global",
        "lift": "up to date",
    }
    assert run(bench, "calibrate.method=dip_global")[1] == ["calibrate"]


def test_a_change_upstream_redoes_the_stages_that_read_the_product(bench):
    run(bench)
    assert reasons(bench, "ingest.scale=2") == {
        "ingest": "ingest.scale changed 1.0 -> 2.0",
        "calibrate": "upstream ingest changed",
        "lift": "upstream ingest changed",
    }
    assert run(bench, "ingest.scale=2")[1] == ["ingest", "calibrate", "lift"]
    assert results(bench)["stages"]["ingest"]["total"] == 16


@pytest.mark.parametrize(
    ("settings", "expected"),
    [(["model.pupil_samples=64"], {"calibrate"}), (["seed=3"], {"calibrate", "lift"})],
)
def test_a_stage_is_redone_only_for_what_it_depends_on(bench, settings, expected):
    run(bench)
    redone = {name for name, reason in reasons(bench, *settings).items() if reason != "up to date"}
    assert redone == expected
    assert reasons(bench, seed=3)["lift"] == "seed changed 0 -> 3"


def test_touching_or_moving_input_files_redoes_nothing(bench):
    run(bench)
    (bench.data / "a.dat").touch()
    moved = bench.folder / "archive" / "data"
    moved.parent.mkdir()
    bench.data.rename(moved)
    assert set(reasons(bench, inputs=[f"cube={moved}"]).values()) == {"up to date"}


def test_a_new_stage_version_redoes_the_stage(bench, monkeypatch):
    run(bench)
    monkeypatch.setattr(sys.modules["irlos_pipe.stages.lift.stage"], "VERSION", 2)
    assert reasons(bench)["lift"] == "stage version 1 -> 2"


def damage_arrays(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("product", ["01_ingest.h5", "03_lift.h5"])
def test_a_product_with_damaged_arrays_is_made_again_whether_or_not_a_stage_reads_it(bench, product):
    run(bench)
    damage_arrays(bench.output / product)
    assert run(bench)[1] == [product[3:-3]]
    assert results(bench)["status"] == "ok"
    assert run(bench)[1] == []


def test_a_product_whose_results_are_not_those_of_its_stage_is_made_again(bench):
    """Written with a right checksum: only its content tells."""
    run(bench)
    path = bench.output / "02_calibrate.h5"
    product = read_product(path)
    write_product(replace(product, results=product.results | {"method": 3}), path)
    assert run(bench)[1] == ["calibrate"]
    assert results(bench)["status"] == "ok"


def test_a_run_from_a_stage_refuses_damaged_arrays_and_leaves_the_results(bench):
    run(bench)
    damage_arrays(bench.output / "01_ingest.h5")
    before = (bench.output / "results.json").read_bytes()
    with pytest.raises(ConfigurationError, match="product of 'ingest' cannot be used"):
        run(bench, "calibrate.method=dip_global", selection=Selection("calibrate"))
    assert (bench.output / "results.json").read_bytes() == before


def test_a_run_up_to_a_stage_keeps_later_results_only_while_they_are_up_to_date(bench):
    run(bench)
    assert set(run(bench, selection=Selection(last="ingest"))[0].results["stages"]) == set(STAGES)
    changed, _ = run(bench, "ingest.scale=3", selection=Selection(last="ingest"))
    assert set(changed.results["stages"]) == {"ingest"}


def test_a_run_from_a_stage_needs_the_earlier_products(bench):
    with pytest.raises(ConfigurationError, match=r"'ingest' cannot be used.*run with --from ingest"):
        run(bench, selection=Selection(first="calibrate"))
    assert not bench.output.exists()


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        (Selection(first="lft"), "--from lft: no stage of recipe 'test'; did you mean 'lift'"),
        (Selection(last="correct"), "--to correct: no stage"),
        (Selection("lift", "ingest"), "--from lift comes after --to ingest"),
    ],
)
def test_a_selection_that_makes_no_sense_is_reported(bench, selection, message):
    with pytest.raises(ConfigurationError, match=message):
        run(bench, selection=selection)


def test_the_resolved_recipe_runs_again_and_is_up_to_date(bench):
    run(bench, "calibrate.method=dip_global")
    resolved = load_recipe(bench.output / "recipe.resolved.yaml")
    assert {step.reason for step in plan_run(resolved, bench.output, Selection())[1]} == {"up to date"}


def test_a_product_of_another_stage_in_its_place_is_made_again(bench):
    run(bench)
    (bench.output / "01_ingest.h5").replace(bench.output / "03_lift.h5")
    assert reasons(bench) == {
        "ingest": "no product yet",
        "calibrate": "up to date",
        "lift": "product unreadable",
    }
    assert run(bench)[1] == ["ingest", "lift"]


def test_an_empty_input_is_nothing_to_process(bench):
    (bench.folder / "empty").mkdir()
    with pytest.raises(NothingToDo, match="input 'cube': no recordings under"):
        run(bench, inputs=[f"cube={bench.folder / 'empty'}"])
