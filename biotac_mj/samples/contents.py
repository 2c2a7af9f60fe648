"""Content of the samples."""

OBJECT, SKIN = "sphere_7mm", "coarse"
# repeated at the same locations with different depths, so that force can be learned where it is evaluated
PLACES, TOUCHES = 10, 50
# log.csv has the first round, every fifth row: `biotac diagnose` solves the skin in each several times
EVERY = 5
# effect of the recorded sensor that the simulated one lacks, for `biotac diagnose` to find
EFFECT = ("warmup", {"a": -0.25, "tau": 5.0})
