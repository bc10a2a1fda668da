"""How fast a model is on this machine, in every way to run it."""
