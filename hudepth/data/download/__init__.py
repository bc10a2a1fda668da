"""Fetching a data set that anybody may download."""
