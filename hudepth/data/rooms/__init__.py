"""The renderer of the built-in rooms."""
