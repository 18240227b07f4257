"""Deployment on a robot: maintenance, repair, comparison of versions, and the pages about them."""
