"""Whether quoted errors hold: pulls of calibrations and ramps over many simulated cubes."""
