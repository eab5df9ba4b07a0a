"""How good the 2x2 modes are: a simulated archive, and three ways to measure defocus."""
