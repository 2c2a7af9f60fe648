"""The rubber: its laws, what it has beyond them, and the tetrahedra that it is made of."""
