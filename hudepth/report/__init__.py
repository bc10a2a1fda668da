"""hudepth-report: results of runs, side by side."""
