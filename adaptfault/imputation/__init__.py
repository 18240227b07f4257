"""Expected readings of missing cells, given the healthy cells."""
