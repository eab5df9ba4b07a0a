"""Reading and writing files safely: atomic writes, JSON, YAML with line numbers, worker processes."""
