"""Faults of a log, whatever the sensor measured. Input: arrays."""
