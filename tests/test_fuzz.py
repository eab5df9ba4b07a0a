"""A sample of the damaged and hostile inputs of ``make fuzz``.

Truth: the result of the same recording without damage, and the exit codes of the contract.
"""

import pytest
from fuzz import judge
from fuzz.case import KINDS

SEEDS = range(3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_damaged_input_causes_at_most_one_line_that_says_what_is_wrong(kind):
    verdicts = [judge.judged(kind, seed) for seed in SEEDS]
    assert [(verdict.seed, verdict.summary, verdict.finding) for verdict in verdicts if verdict.finding] == []
