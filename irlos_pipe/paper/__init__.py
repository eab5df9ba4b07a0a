"""The paper's experiments, one file each, and the run of all of them."""
