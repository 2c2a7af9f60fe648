"""The tasks of one finger and of two fingertips."""
