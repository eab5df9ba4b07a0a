"""``python -m benchmarks.diagnose_suite``."""

from benchmarks.diagnose_suite.working import main

main(prog_name="python -m benchmarks.diagnose_suite")
