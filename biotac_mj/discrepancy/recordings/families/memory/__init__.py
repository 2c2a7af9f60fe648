"""What comes late: latency, low-pass, relaxation, hysteresis."""
