"""Readings before anything is inferred: missing values, baseline and noise, offset tracking, load,
transport."""
