"""What the samples are of."""

__all__ = ["EFFECT", "EVERY", "OBJECT", "SKIN", "TOUCHES"]

OBJECT, SKIN = "sphere_7mm", "coarse"
TOUCHES = 20
EVERY = 5  # row of the recording is in log.csv: `biotac diagnose` solves the skin in each again and again
# what the recorded sensor has and the simulated one lacks, for `biotac diagnose` to find
EFFECT = ("warmup", {"a": -0.25, "tau": 5.0})
