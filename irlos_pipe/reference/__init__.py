"""What stages, keys, effects, checks and numbers mean, from the places that define them."""

from pathlib import Path

# The JSON Schemas that `maintenance.schema` writes.
RESULTS = Path(__file__).with_name("results.schema.json")
COMMANDS = Path(__file__).with_name("commands.schema.json")
FILES = {"results": RESULTS, "commands": COMMANDS}
