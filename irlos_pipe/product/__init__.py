"""HDF5 products, typed results, the run folder and export."""
