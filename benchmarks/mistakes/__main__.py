"""``python -m benchmarks.mistakes``."""

from benchmarks.mistakes.suite import main

main(prog_name="python -m benchmarks.mistakes")
