"""Names in the help, without importing the modules that define them (tests compare them)."""

INDENTERS = (
    "sphere_3-5mm sphere_7mm sphere_14mm cylinder_short_3-5mm cylinder_short_7mm cylinder_long_7mm "
    "cube_14mm ring_7mm"
).split()
TIERS = ("full", "condensed")
MATERIALS = ("default", "paper", "rubber", "ansys", "calibrated")
SKINS = ("coarse", "default", "fine")
PEGS = "peg_round_4mm peg_round_8mm peg_square_5mm peg_square_10mm peg_hexagon_8mm peg_triangle_8mm".split()
OBJECTS = (*INDENTERS, *PEGS, "table_surface", "table_edge", "table_corner")
INTERACTIONS = ("press", "slide", "twist", "tap")
TASKS = ("roll_rod", "insert_peg", "follow_edge")
CONFIGURATIONS = ("deformable_shell", "shell_with_core", "solid_with_core", "solid")
INDENTER_HELP = (
    f"one of {', '.join(INDENTERS)} (the number is a diameter); or geom:TYPE:SIZE[,SIZE...] with MuJoCo's "
    "sphere, capsule, cylinder, ellipsoid, box or plane and its half-sizes, as in geom:capsule:3mm,5mm, and "
    "geom:sphere:2.5mm for a sphere of that radius; or mesh:FILE in metres"
)
LOCATION_HELP = (
    "where: X; or X and ANGLE around the finger, 0 on the pad's midline, positive towards +z, as in -12mm "
    "30deg; or X Y Z, moved to the nearest point of the skin. BioTac frame: tip at -x, pad at -y, nail at +y"
)
