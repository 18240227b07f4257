"""Files that people look at: MCAP for Foxglove, RRD for Rerun, and the diagnostics of ROS."""
