"""File formats of recordings: CSV folders, ROS bags, numpy arrays and archives."""
