"""A focus loop that is given bad exposures, bad messages and bad files, and hours of right ones."""
