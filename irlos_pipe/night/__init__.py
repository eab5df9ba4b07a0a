"""A night of recordings, or an archive of nights: find, group, reduce, follow over time, report."""

import irlos_pipe.report  # noqa: F401 (before any module imports matplotlib)
