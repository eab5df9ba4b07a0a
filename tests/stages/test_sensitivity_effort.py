"""A sensitivity scan says what it will take before it begins. Truth: products of small numbers."""

import logging

import pytest

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.stages.sensitivity import announce

LOG = logging.getLogger("test_sensitivity_effort")


def test_a_scan_that_the_memory_cannot_hold_is_refused_before_it_begins(monkeypatch):
    monkeypatch.setattr("irlos_pipe.files.processes.available_bytes", lambda: 1e9)
    announce(20, (64, 64), 5, 6, 4, LOG)
    with pytest.raises(ConfigurationError, match=r"3.3 GB of memory.*sensitivity.realisations"):
        announce(20, (64, 64), 1000, 6, 4, LOG)
