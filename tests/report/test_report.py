"""The report as a whole: one file, complete, whatever stages and values there are."""

import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product import storage
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.report.build import write_report
from irlos_pipe.report.section_run import MOST_THUMBNAILS
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.model.untested import BY_RAMP, untested_by_cubes


class Page(HTMLParser):
    """What a test wants to know of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.identifiers, self.references, self.loaded, self.open = text, [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if "id" in values:
            self.identifiers.append(values["id"])
        for name in ("href", "xlink:href", "src"):
            if name in values and (tag != "a" or values[name].startswith("#")):  # other links load nothing
                (self.references if values[name].startswith("#") else self.loaded).append(values[name])
        if tag in ("section", "details", "div", "figure", "table"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in ("section", "details", "div", "figure", "table"):
            assert self.open.pop() == tag

    @property
    def sections(self) -> list[str]:
        return re.findall(r'<section id="([^"]*)"', self.text)


def report(folder: Path, made: list[Product], **told) -> Page:
    return Page(write_report(made_run.write_run(folder, made, **told)).read_text(encoding="utf-8"))


def spoiled(product: Product) -> Product:
    """The product with NaN for every number of its arrays and None for every number of its results."""
    arrays = {
        name: replace(quantity, value=_without_numbers(quantity.value))
        for name, quantity in product.arrays.items()
    }
    return replace(product, arrays=arrays, results=_without_results(product.results))


def _without_numbers(value: np.ndarray) -> np.ndarray:
    return np.full(np.shape(value), np.nan) if np.asarray(value).dtype == float else value


def _without_results(content):
    if isinstance(content, dict):
        return {key: _without_results(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_without_results(value) for value in content]
    return None if isinstance(content, float) else content


def test_a_product_of_another_run_is_not_shown_as_that_of_this(tmp_path):
    folder = made_run.write_run(tmp_path / "a", made_run.products("ingest"))
    (other,) = made_run.products("ingest")
    other.results["inputs"][0]["frames"] = 7
    shutil.copy(made_run.write_run(tmp_path / "b", [other]) / "01_ingest.h5", folder)
    with pytest.raises(
        InputDataError, match=r"01_ingest\.h5: not the product that results\.json was made from"
    ):
        write_report(folder)


@pytest.mark.slow
def test_a_full_page_is_whole_has_numbers_with_their_units_and_a_browser_runs_and_loads_nothing(tmp_path):
    full = report(tmp_path, made_run.products())
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', full.text)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"  # scripts, frames, fonts, connections
    assert rules["img-src"] == "data:"
    assert "script-src" not in rules
    assert all(address.startswith("data:") for address in full.loaded)
    assert not re.search(r"\son\w+=|javascript:|<script|<link|@import", full.text)
    assert len(full.identifiers) == len(set(full.identifiers))
    assert full.open == []
    wanted = {reference[1:] for reference in full.references} | set(re.findall(r"url\(#([^)]*)\)", full.text))
    assert wanted <= set(full.identifiers)
    for shown in (
        "50.0 ± 2.8 nm", "22.4 ± 2.8 nm", "0.998 ± 0.003", "+1.0 nm", "1.2 nm RMS", "≥ 16.0 mag",
        "0.631 → 0.742", "0.50 arcsec", "110 nm RMS", "6.9 mas RMS", "HD 1", "2024-02-11 02:20", "dip_avg",
        "1.2340 ± 0.0030", "13.3", "0123456789ab", "numpy 2.4.6", "derotator_angle_deg", "4 defocus",
    ):  # fmt: skip
        assert shown in full.text, shown


@pytest.mark.slow
def test_the_same_products_give_the_same_file(tmp_path):
    folder = made_run.write_run(tmp_path, made_run.products("ingest", "lift"))
    first = write_report(folder).read_bytes()
    assert write_report(folder).read_bytes() == first


@pytest.mark.slow
@pytest.mark.parametrize("stage", made_run.STAGES)
def test_missing_numbers_arrays_and_results_never_stop_the_report(tmp_path, stage):
    for made in (spoiled(made_run.STAGES[stage]()), Product(stage, {}, {})):
        page = report(tmp_path, [made_run.ingest(), made] if stage != "ingest" else [made])
        assert stage in page.sections
        assert not re.search(r"\bnan\b|\bNone\b", page.text)


CAUSE = {"says": "pixels of 9.7 mas instead of 10", "explains": 0.97, "figure": "cal-residual"}


@pytest.mark.slow
@pytest.mark.parametrize(("after", "value"), [(0.742, 0.3), (0.742, 9.0), (0.6, 0.3)])
def test_the_first_screen_says_whether_the_correction_may_be_applied_and_why_not(tmp_path, after, value):
    """A failed check stands above the numbers with its value, limit, causes and a link to what is there."""
    made = made_run.products("ingest", "calibrate", "correct")
    check = Check("chi2 of the mean image", value, "", None, 0.5, "too much")
    causes = [CAUSE, {"says": "a spectrum about 1650 nm", "figure": "not drawn"}]
    made[1] = replace(made[1], checks=[check], results=made[1].results | {"causes": causes})
    made[2].results["strehl_after"] = after
    page = report(tmp_path, made)
    head = page.text[: page.text.index('<dl class="numbers">')]
    tiles = page.text[len(head) : page.text.index("<main>")]
    if value < 0.5:
        assert "may be applied" in head and "<h2" not in head
        assert ("no gain predicted" in tiles) == (after < 0.631)
        return
    assert "do not apply" in head and "9 (limit 0.5)" in head and "97% of the misfit" in head
    assert head.index("too much") < head.index(CAUSE["says"]) < head.index("1650 nm")
    assert head.count('href="#cal-residual"') == 2 and head.count('href="#calibrate"') == 1
    assert "do not apply" in tiles and "→" not in tiles
    assert {link[1:] for link in page.references} <= set(page.identifiers)


def test_warnings_and_lost_exposures_are_shown(tmp_path):
    made = [
        replace(
            made_run.ingest(),
            log=["INFO all is well", "WARNING no dark"],
            provenance={"failures": ["x.fits: truncated"]},
        )
    ]
    text = report(tmp_path, made).text
    assert "ingest: no dark" in text
    assert "x.fits: truncated" in text
    assert "all is well" not in text


def test_what_a_diagnosis_says_of_files_cannot_change_the_page(tmp_path):
    hostile = '"><img src=x onerror=alert(1)>'
    results = {"verdict": "unknown", "grade": "unknown", "sentence": hostile, "why_unknown": hostile}
    step = {"effect": hostile, "phrase": hostile, "shown": {hostile: 1.0}}
    made = [Product("diagnose", {}, results | {"nearest": step, "untestable": [hostile]})]
    text = report(tmp_path, made).text
    assert "<img" not in text
    assert text.count("&lt;img src=x") >= 5
    assert "why it is not named" in text


def test_the_page_of_a_diagnosis_opens_with_its_verdict_and_numbers_with_errors(tmp_path):
    step = {"effect": "companion", "shown": {"flux_ratio": 0.04}, "shown_sigma": {"flux_ratio": 0.0002}}
    results = {"verdict": "effect", "grade": "complete", "sentence": "Missing: a star.", "steps": [step]}
    text = report(tmp_path, [Product("diagnose", {}, results)]).text
    head = text[: text.index("<main>")]
    assert '<p class="verdict good">Missing: a star.' in head and "4.000 ± 0.020 %" in head


@pytest.mark.slow
def test_a_night_of_recordings_does_not_blow_up_the_page(tmp_path):
    product = made_run.ingest()
    rows = [made_run.row(f"r{i:03d}", "cube", 1) for i in range(MOST_THUMBNAILS + 20)]
    arrays: dict[str, Quantity] = {}
    for row in rows:
        one = made_run.recording(row["name"], "cube", 1)
        arrays |= made_run.arrays_from_recording(one)
    text = report(tmp_path, [replace(product, arrays=arrays, results={"inputs": rows})]).text
    assert text.count("<img") == MOST_THUMBNAILS
    assert f"r{MOST_THUMBNAILS + 19:03d}" in text


@pytest.mark.slow
def test_no_frames_are_read_for_the_page(tmp_path, monkeypatch):
    read = []
    real = storage._read_array
    monkeypatch.setattr(storage, "_read_array", lambda dataset: read.append(dataset.name) or real(dataset))
    assert "<img" in report(tmp_path, made_run.products()).text
    assert read and not [name for name in read if name.endswith(("/images_e", "/raw_adu"))]


# -- what the data cannot tell is said before the numbers, in results.json first ----------------


def test_results_begin_with_what_was_not_tested():
    lines = untested_by_cubes({6: -170.0})
    first, *_ = CalibrateResults(wfe_nm=1.0, untested=lines).as_json().items()
    assert first == ("untested", lines) and "Noll 6 -170 nm" in lines[0]
    assert "untested" not in CalibrateResults(wfe_nm=1.0).as_json()


@pytest.mark.slow
def test_the_report_says_so_once_above_the_numbers(tmp_path):
    made = [made_run.calibrate(), made_run.lift()]
    lines = untested_by_cubes({6: -170.0})
    for product, own in zip(made, (lines, BY_RAMP), strict=True):
        product.results["untested"] = list(own)
    page = report(tmp_path, made).text
    assert 0 < page.index(lines[0]) < page.index('<dl class="numbers">')
    assert all(page.count(line) == 1 for line in {*lines, *BY_RAMP})
