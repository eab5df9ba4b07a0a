"""The functions for Python programs, importable from `irlos_pipe` itself."""
