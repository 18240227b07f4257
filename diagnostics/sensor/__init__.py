"""Findings about the whole sensor: what all cells, or those of a pad, share."""
