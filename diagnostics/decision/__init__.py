"""From log ratios to the diagnosis: calibration, prevalence, root causes, coverage."""
