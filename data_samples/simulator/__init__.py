"""Simulator of the data samples, built on HCIPy and independent of the package it is used to test."""
