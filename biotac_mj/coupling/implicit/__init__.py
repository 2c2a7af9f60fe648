"""The implicit step: forces of all BioTacs of one mjData and the motion of their bodies, found together."""
