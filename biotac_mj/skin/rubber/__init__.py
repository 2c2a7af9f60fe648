"""The rubber: material laws, memory (viscoelasticity), friction and the kernels of its tetrahedra."""
