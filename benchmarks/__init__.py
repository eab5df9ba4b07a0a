"""Timings of irlos_pipe beside other implementations, on the same frames in the same run.

``python -m benchmarks`` (or ``make bench``); not part of the package.
"""
