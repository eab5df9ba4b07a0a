"""``python -m benchmarks.misled``."""

from benchmarks.misled.suite import main

main(prog_name="python -m benchmarks.misled")
