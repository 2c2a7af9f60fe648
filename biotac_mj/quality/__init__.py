"""What is wrong with a log as a log, whatever the sensor did: it takes arrays."""
