"""Every experiment of the paper: run the recipes, put their reports and numbers together."""
