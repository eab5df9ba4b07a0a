"""Simulated observations: a spec becomes the files of the instrument, and the truth beside them."""

from irlos_pipe.simulate.recordings.run import plan_simulation, simulate
from irlos_pipe.simulate.recordings.spec import load_spec
from irlos_pipe.simulate.recordings.summary import plan_rows, where_text

__all__ = ["load_spec", "plan_rows", "plan_simulation", "simulate", "where_text"]
