"""The run of all experiments: recipes, common report, numbers, tables."""
