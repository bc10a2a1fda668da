"""hudepth-train: the module, its optimisation, and what happens around an epoch."""
