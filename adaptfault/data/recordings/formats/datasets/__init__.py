"""Data sets of robot learning and of laboratories: LeRobot, Parquet, Zarr, HDF5, MAT, JSON
lines."""
