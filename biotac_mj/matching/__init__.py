"""A recording of a flat press against simulated states of the sensor."""
