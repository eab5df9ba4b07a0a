"""Commands of pages that a small run of stand-in stages is enough for are executed."""

import re
import shlex

import pytest
from conftest import Bench, invoke
from helpers.paths import REPOSITORY
from test_docs import commands, is_sketch

DOCS = REPOSITORY / "docs"
# Of these nothing is computed; what else the pages call takes real data, or has tests of its own.
QUICK = ("status", "show", "explain", "export", "report", "compare")
PAGES = ("expectations.md", "data.md")
ELSEWHERE = ("KEY", "--aot", "reduced")  # a placeholder; tests/readers/test_aot.py; the versions below


def quick_calls(page: str) -> list[str]:
    """The calls of a page that are spelt out and can be executed on any run, here called demo."""
    found = commands((DOCS / page).read_text(encoding="utf-8"), "irlos")
    calls = [shlex.join(call) for call in found if call[0] in QUICK and not is_sketch(call)]
    return [re.sub(r"\bDIR\b", "demo", call) for call in calls if not any(word in call for word in ELSEWHERE)]


CALLS = sorted({call for page in PAGES for call in quick_calls(page)})


def filled_in(call: str, bench: Bench) -> list[str]:
    """A call with names of what is there in place of those of the page."""
    names = {
        r"demo/03_calibrate\.h5": f"{bench.output}/02_calibrate.h5",
        r"PRODUCT\.h5": f"{bench.output}/02_calibrate.h5",
        r"zernike_nm": "mean",
        r"demo": str(bench.output),
        r"(\S+)\.(csv|fits|sqlite|json)": rf"{bench.folder}/\1.\2",
        r"FILE": f"{bench.folder}/checks.csv",
    }
    words = shlex.split(call)
    for name, value in names.items():
        words = [re.sub(rf"^{name}$", value, word) for word in words]
    return words


@pytest.mark.parametrize("call", [call for call in CALLS if call.startswith("explain")])
def test_what_a_page_has_explained_is_explained(call):
    result = invoke(*shlex.split(call))
    assert result.exit_code == 0 and result.output


@pytest.mark.parametrize("call", [call for call in CALLS if not call.startswith("explain")])
def test_a_command_of_a_page_works(bench, call):
    bench.run()
    result = invoke(*filled_in(call, bench))
    assert result.exit_code == 0, result.output


def test_the_pages_have_such_commands():
    assert {call.split()[0] for call in CALLS} >= {"status", "show", "compare", "explain", "export", "report"}


def test_versions_are_kept_listed_and_compared_as_the_page_on_data_says(bench):
    """The three lines of the page, one after the other; the first reduces the stand-in recording."""
    text = (DOCS / "data.md").read_text(encoding="utf-8")
    (block,) = [
        one for one in re.findall(r"^```sh\n.*?^```", text, re.DOTALL | re.MULTILINE) if "--numbered" in one
    ]
    run, *others = commands(block, "irlos")
    assert run[:2] == ["run", "full_reduction"] and run[-3:] == ["--output", "reduced", "--numbered"]
    for call in (["run", str(bench.recipe), *run[-3:]], *others):
        words = [re.sub(r"^reduced(?=/|$)", str(bench.output), word) for word in call]
        result = invoke(*words)
        assert result.exit_code == 0, result.output
