"""Progress of a run that nobody watches."""

import logging

from irlos_pipe.pipeline import resources


def test_a_log_has_a_line_now_and_then_that_says_what_is_left(caplog, capfd):
    shown = resources.logged_progress(total=4, desc="fits", mininterval=0)
    with caplog.at_level(logging.INFO), shown as bar:
        bar.update(3)
        bar.update(1)
    assert len(caplog.records) == 1  # none before the first is done, none after the last
    assert "fits: 3 of 4" in caplog.text
    assert capfd.readouterr() == ("", "")
