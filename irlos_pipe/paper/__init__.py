"""The paper's experiments, one folder each, and the run of all of them."""
