"""From a checkpoint to files that other programs run: each is checked against the checkpoint before it is kept."""
