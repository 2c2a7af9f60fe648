"""Detectors for plain recordings, beside those for faults of the log (`quality`): each module finds and fits
one class of effects. Several compare levels with `trends`."""
