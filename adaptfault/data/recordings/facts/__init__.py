"""Facts about a sensor: what a file states, what is inferred from its readings, and why."""
