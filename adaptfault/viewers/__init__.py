"""Files that people look at: HTML pages, MCAP for Foxglove, RRD for Rerun."""
