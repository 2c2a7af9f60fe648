"""Models of single rows: force, contact position and a code from the electrodes of recordings or data
sets."""
