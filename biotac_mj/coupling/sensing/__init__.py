"""What a solved skin is felt as: settings of the readings, counts of every channel, vibration."""
