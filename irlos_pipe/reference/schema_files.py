"""Where the JSON Schemas lie that `reference.schema` writes."""

from pathlib import Path

RESULTS = Path(__file__).with_name("results.schema.json")
COMMANDS = Path(__file__).with_name("commands.schema.json")
FILES = {"results": RESULTS, "commands": COMMANDS}
