"""Checks made besides score tests: noise, motion, drift, single pixels."""
