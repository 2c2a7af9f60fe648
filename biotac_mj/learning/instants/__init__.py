"""What the electrodes tell instant by instant, from recordings or data sets: force, place, code."""
