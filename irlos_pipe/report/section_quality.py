"""Section on quality control."""

from __future__ import annotations

from irlos_pipe.product.product import Check
from irlos_pipe.report.content import Section, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number

COLUMNS = ("", "stage", "check", "value", "limits", "message")
# A stage with more passed checks than this shows them when asked.
FOLDED_ABOVE = 10


def quality_section(run: RunData) -> Section | None:
    """Build the section: failed checks first, then those of each stage; None without any check."""
    checks = [(stage, check) for stage, product in run.products.items() for check in product.checks]
    if not checks:
        return None
    failed = [(stage, check) for stage, check in checks if not check.passed]
    passed = {
        name: [(stage, check) for stage, check in checks if stage == name and check.passed]
        for name in run.products
    }
    tables = [_table("Failed", failed)] if failed else []
    few = [one for found in passed.values() if len(found) <= FOLDED_ABOVE for one in found]
    tables += [_table("Passed", few)] if few else []
    tables += [
        _table(f"{stage}: {len(found)} passed", found, folded=True)
        for stage, found in passed.items()
        if len(found) > FOLDED_ABOVE
    ]
    return Section("quality", "Quality control", quality_text(run), tables)


def quality_text(run: RunData) -> str:
    """Return how many checks passed."""
    checks = [check for product in run.products.values() for check in product.checks]
    return f"{sum(check.passed for check in checks)} of {len(checks)} checks passed"


def _table(title: str, checks: list[tuple[str, Check]], folded: bool = False) -> Table:
    marks = ["good" if check.passed else "bad" for _, check in checks]
    rows = [_row(stage, check) for stage, check in checks]
    return Table(COLUMNS, rows, title, marks=marks, folded=folded, prose=True)


def _row(stage: str, check: Check) -> tuple[str, ...]:
    unit = "" if check.unit == "1" else check.unit
    verdict = "passed" if check.passed else "FAILED"
    name = check.name.removeprefix(f"{stage}/")
    return verdict, stage, name, number(check.value, ".4g", unit), check.limits, check.message
