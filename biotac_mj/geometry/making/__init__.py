"""Makes skins: shapes of pads, assembly from a mesh and rigid bodies, import of files."""
