"""Deployment on a robot: the bundle, its model versions, maintenance, and prediction."""
