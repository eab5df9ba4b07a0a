"""Mistakes on purpose: are they noticed, and is the true cause named?"""
