"""The tasks, one module each, on one finger (`finger`) or two fingertips (`gripper`)."""
