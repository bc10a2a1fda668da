"""Sources, the depth store, splits and batches."""
