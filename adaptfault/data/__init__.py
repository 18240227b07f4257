"""Recordings, calibration, windows and simulated grasps; files written whole."""
