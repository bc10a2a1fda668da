"""Multirun: sweeps and searches over configurations."""
