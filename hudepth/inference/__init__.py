"""Prediction with a trained model: images in, depth in metres out, from any model file."""
