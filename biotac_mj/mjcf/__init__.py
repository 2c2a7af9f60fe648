"""The model and its scenes; data only."""
