"""What noise says: hum, cross-talk, louder electrodes."""
