"""Contact events: a log segmented into contacts, with constant runs and jumps of each cell."""
