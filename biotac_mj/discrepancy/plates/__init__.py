"""Recordings of flat presses against simulated states of the skin: what then disagrees, stage by stage."""
