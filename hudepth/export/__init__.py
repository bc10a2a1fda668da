"""Export a checkpoint to files that other programs run; each is compared with the checkpoint before it is kept."""
