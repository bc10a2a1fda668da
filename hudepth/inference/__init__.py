"""A trained model in use: images in, depth in metres out, whatever file the model comes from."""
