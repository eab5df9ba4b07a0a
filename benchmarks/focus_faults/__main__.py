"""``python -m benchmarks.focus_faults``."""

from benchmarks.focus_faults.suite import main

main(prog_name="python -m benchmarks.focus_faults")
