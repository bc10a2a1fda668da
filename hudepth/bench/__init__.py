"""How fast a model is on this machine, beside what else one could pick."""
