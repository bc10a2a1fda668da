"""hudepth-test: scoring a model under test protocols."""
