"""The evidence terms: each turns a log into one log likelihood ratio for every cell."""
