"""What maintainers run: reference pages, JSON Schemas and tables of the docs, made from the program."""
