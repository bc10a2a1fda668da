"""Calibration: a trained model's metres fitted to a camera and its scenes, on a few measured depths."""
