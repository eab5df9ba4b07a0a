"""HDF5 products, the run folder, export and comparison with a known truth."""
