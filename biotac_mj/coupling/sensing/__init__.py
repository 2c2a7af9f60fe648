"""From a solved skin to readings: settings of the readings, counts of every channel, vibration."""
