"""Changes to the colours and the geometry of batches, on whatever device they are."""
