"""Timings next to other implementations (``python -m benchmarks``, ``make bench``), and suites of cases.

``harness`` is what the suites share; none of it is part of the package.
"""
