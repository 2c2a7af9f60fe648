"""The implicit step of `coupling/implicit/` for all worlds at once: forces and motion found together."""
