"""Recipes for ESO's PyCPL, called by pyesorex and EDPS; this package is their recipe directory."""
