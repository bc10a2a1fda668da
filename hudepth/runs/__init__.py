"""Everything a run leaves behind, with one reader for each kind of file."""
