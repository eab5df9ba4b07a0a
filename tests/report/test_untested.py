"""What the data cannot tell is said before the numbers: in the report above the tiles, in results.json first.

Truth: the degeneracies of phase diversity. An image stays the same when the wavefront is turned by 180° and
its sign changes, which reverses the even modes alone: their sign comes with that of the diversity.
"""

import json

from helpers import made_run

from irlos_pipe.report.build import write_report
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.model.untested import BY_RAMP, untested_by_cubes

CAUSES = (
    "sign of the even modes",
    "size and mode of the diversity",
    "transposed",
    "180°",
    "same factor",
    "flat",
)


def test_results_begin_with_what_was_not_tested():
    results = CalibrateResults(wfe_nm=1.0, untested=untested_by_cubes({6: -170.0}))
    first, lines = next(iter(results.as_json().items()))
    assert first == "untested" and "Noll 6 -170 nm" in lines[0]
    assert all(any(cause in line for line in lines) for cause in CAUSES)
    assert json.dumps(results.as_json()).startswith('{"untested"')
    assert "untested" not in CalibrateResults(wfe_nm=1.0).as_json()


def test_the_report_says_so_once_above_the_numbers(tmp_path):
    made = [made_run.calibrate(), made_run.lift()]
    lines = untested_by_cubes({6: -170.0})
    for product, own in zip(made, (lines, BY_RAMP), strict=True):
        product.results["untested"] = list(own)
    page = write_report(made_run.write_run(tmp_path, made)).read_text()
    assert 0 < page.index(lines[0]) < page.index('<dl class="numbers">')
    assert all(page.count(line) == 1 for line in {*lines, *BY_RAMP})
