"""Evidence and verdict where the poses of the touching object are known."""
