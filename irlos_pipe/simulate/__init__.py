"""The simulator of scenes; it shares no optics with the model that is fitted to its images."""
