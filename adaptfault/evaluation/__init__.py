"""Scores, sensitivity to single faults, the demo and its HTML report."""
