"""Fleets: the list of robots, their maintenance on worker processes, and the summary."""
