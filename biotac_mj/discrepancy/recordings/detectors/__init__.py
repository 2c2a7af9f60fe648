"""What can be wrong with a plain recording beside faults of the log (`quality`): each module finds and fits
one class of effects; `trends` is what several compare levels with."""
