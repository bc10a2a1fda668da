"""The numbers of a sweep: rows, intervals and differences, without a network."""
