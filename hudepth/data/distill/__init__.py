"""What a student learns from beside ground truth: a teacher's depths, of training pairs and of pictures alone."""
