"""Where things lie in the repository, and next to it."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGE = REPOSITORY / "irlos_pipe"
RECIPES = REPOSITORY / "recipes"
SAMPLES = REPOSITORY / "data_samples"
SHARED = REPOSITORY.parent / "shared"
HELPERS = REPOSITORY / "tests" / "helpers"
