"""The network of the paper: training, files, export, inference."""
