"""Effects that a recording alone can show: found in it, applied to counts, taken out of them."""
