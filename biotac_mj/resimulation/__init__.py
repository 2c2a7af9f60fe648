"""Recordings of real sensors with the simulated skin beside them: what it was like under each reading."""
