"""The focus loop as processes: a simulated telescope, the faults of a night, and how both are survived."""
