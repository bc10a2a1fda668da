"""hudepth-data audit: leaks between subsets, units, duplicates."""
