"""Simulated faults: injected into recordings, or into a circuit model of the array."""
