"""Data sets of the field, each read in the layout of its own archives."""
