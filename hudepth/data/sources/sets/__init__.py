"""Public data sets, each read in the layout of its own archives."""
