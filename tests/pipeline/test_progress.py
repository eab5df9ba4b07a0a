"""Progress of a run that nobody watches."""

import logging

import pytest

from irlos_pipe.pipeline import resources


def test_a_log_has_a_line_now_and_then_that_says_what_is_left(caplog, capfd):
    shown = resources.logged_progress(total=4, desc="fits", mininterval=0)
    with caplog.at_level(logging.INFO), shown as bar:
        bar.update(3)
        bar.update(1)
    assert len(caplog.records) == 1  # none before the first is done, none after the last
    assert "fits: 3 of 4" in caplog.text
    assert capfd.readouterr() == ("", "")


def test_more_steps_than_expected_are_logged_with_their_time(caplog):
    shown = resources.logged_progress(total=2, desc="fits", mininterval=0)
    with caplog.at_level(logging.INFO), shown as bar:
        bar.update(5)
    assert "fits: 5 steps" in caplog.text


@pytest.mark.parametrize("count", [1, 50])
def test_what_takes_less_than_half_a_minute_logs_nothing(caplog, count):
    with caplog.at_level(logging.INFO):
        assert list(resources.logged_progress(range(count), desc="recordings")) == [*range(count)]
    assert not caplog.records
