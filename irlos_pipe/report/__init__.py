"""report.html: one section per stage, drawn from the products of a run."""
