"""The slow focus loop without images and files: disturbance, linear theory, controller, exposures."""
