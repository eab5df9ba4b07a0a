"""A night of recordings, or an archive of nights: find, group, reduce, follow over time, report."""
