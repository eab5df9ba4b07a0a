"""Commands of README and pages that a small run of stand-in stages is enough for are executed."""

import re
import shlex

import pytest
from conftest import Bench, invoke
from helpers.paths import REPOSITORY
from test_docs import commands, is_sketch

PAGES = ("README.md", "docs/expectations.md", "docs/data.md")
# Of these nothing is computed; what else the pages call takes real data, or has tests of its own.
QUICK = ("status", "show", "explain", "export", "report", "compare", "recipes")
ELSEWHERE = ("KEY", "NAME", "--aot", "reduced")  # placeholders; tests/readers; the versions below


def quick_calls(page: str) -> list[str]:
    """The calls of a page that are spelt out and can be executed on any run, here called demo."""
    found = commands((REPOSITORY / page).read_text(encoding="utf-8"), "irlos")
    calls = [shlex.join(call) for call in found if call[0] in QUICK and not is_sketch(call)]
    calls = [re.sub(r"\bDIR(_[AB])?\b", "demo", call) for call in calls]
    return [call for call in calls if not any(word in call for word in ELSEWHERE)]


def filled_in(words: list[str], bench: Bench) -> list[str]:
    """A call with names of what is there in place of those of the page."""
    names = {
        r"demo/03_calibrate\.h5|PRODUCT\.h5": f"{bench.output}/02_calibrate.h5",
        r"zernike_nm": "mean",
        r"demo": str(bench.output),
        r"(\S+)\.(csv|fits|sqlite|json)": rf"{bench.folder}/\1.\2",
        r"FILE": f"{bench.folder}/checks.csv",
    }
    for name, value in names.items():
        words = [re.sub(rf"^(?:{name})$", value, word) for word in words]
    return words


@pytest.mark.parametrize("call", sorted({call for page in PAGES for call in quick_calls(page)}))
def test_a_command_of_a_page_works(request, call):
    words = shlex.split(call)
    if words[0] not in ("explain", "recipes"):
        bench = request.getfixturevalue("bench")
        bench.run()
        words = filled_in(words, bench)
    result = invoke(*words)
    assert result.exit_code == 0 and result.output, result.output
