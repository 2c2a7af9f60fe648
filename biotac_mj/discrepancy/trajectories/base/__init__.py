"""What the base model itself is off by: what is fitted with every effect, and what has a name."""
