"""Facts and conventions that both the model and the simulator may know."""
