"""Prediction: graphs for onnxruntime, sessions, and the predictor that follows a bundle."""
