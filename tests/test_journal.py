"""Searches that go on where they stopped: the journal that fuzz and faults keep.

Truth: entries written down by hand.
"""

from helpers.journal import Journal


def test_a_journal_goes_on_after_a_line_that_was_cut_off(tmp_path):
    path = tmp_path / "there" / "journal"
    Journal(path).add("a", finding="")
    with path.open("a") as file:
        file.write('{"key": "b", "find')
    again = Journal(path)
    assert list(again.entries) == ["a"]
    again.add("b", finding="x")
    assert Journal(path).entries["b"] == {"key": "b", "finding": "x"}


def test_a_journal_without_a_file_keeps_its_entries_in_memory():
    journal = Journal(None)
    journal.add("a", code=1)
    assert journal.entries == {"a": {"key": "a", "code": 1}}
