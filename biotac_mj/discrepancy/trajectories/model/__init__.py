"""The simulator that is compared with data: what the skin does along them, and its small changes."""
