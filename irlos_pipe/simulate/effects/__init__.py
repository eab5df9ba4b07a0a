"""Effects that a scene can contain: one file per family, each with all that the effect does."""
