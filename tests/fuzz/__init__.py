"""Damaged, absurd and hostile inputs for the command line, drawn from a seed.

``make fuzz`` runs some thousands of cases, ``tests/test_fuzz.py`` a sample. A case is a folder with
one spoiled input and a command line; `judge` says what no input may ever bring about: a traceback,
an undocumented exit code, a hang, more than 2 GB, a file outside the output folder, or a result that
differs from that of the unspoiled input without a word.
"""

from fuzz import fits_kinds, name_kinds, product_kinds, tree_kinds, yaml_kinds  # noqa: F401
