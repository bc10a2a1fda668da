"""What every other package builds on; it imports nothing of hudepth but itself."""
