"""A step at its balance, linear in all that it depends on."""
