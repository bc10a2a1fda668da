"""Where a training's curves, pictures and test results go, besides the files of its run directory."""
