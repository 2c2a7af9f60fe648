"""What skin and sensor can do, and by which path: two tables, of which `docs/features.md` is made and which
`tests/test_features.py` and `tests/test_features_senses.py` walk.

    python scripts/features.py > docs/features.md
"""

import dataclasses

__all__ = [
    "FEATURES",
    "PATHS",
    "SENSES",
    "SENSE_PATHS",
    "Absent",
    "Feature",
    "Refused",
    "Sense",
    "markdown",
]

# name of a path -> what it is
PATHS = {
    "CPU": "`skin.step`, one world on the CPU",
    "CUDA": "`skin.step`, one world on CUDA",
    "worlds": "`skin.step`, many worlds, on either device",
    "batch": "`batch.attach` inside `mujoco_warp.step`, and `batch.make`",
    "attach": '`biotac_mj.attach`, tier "full" (`biotac press`, tasks)',
    "condensed": '`biotac_mj.attach`, tier "condensed"',
    "calibrate": "`calibration.calibrate`, `biotac lab calibrate`",
    "compare": "`calibration.comparison.evaluate`, `biotac lab compare`",
    "generate": '`biotac data generate`, tier "full"',
    "diagnose": '`discrepancy`\'s Simulator, `biotac diagnose`, tier "full"',
}


# the same for the sensor
SENSE_PATHS = {
    "attach": '`biotac_mj.attach`, tier "full"',
    "condensed": '`biotac_mj.attach`, tier "condensed" (tasks use it)',
    "batch": "`batch.attach` and `batch.make`",
    "tasks": "the suite and Gymnasium, `biotac=` settings of the Entity",
    "press": "`biotac press`",
    "generate": '`biotac data generate`, tier "full"',
    "quick set": '`biotac data generate`, tier "condensed"',
}


# the same by fingertip; `tests/test_designs.py` walks the second column
DESIGN_COLUMNS = ("BioTac (19 electrodes)", "BioTac SP (24 electrodes)", "pad of your own")
_DESIGN = """A fingertip is a `Design` (`biotac_mj/geometry/design.py`, `docs/howto/pads.md`): electrodes,
channels and the frame of the multiplexer are from there. Data of one fingertip and a skin of another
are refused by name."""
DESIGN_ROWS = {
    "`attach`, both tiers, one-way and two-way; `press`": ("yes", "yes", "yes"),
    "tasks, `BioTac` of dm_control's composer": ("yes", "yes", "where it has electrodes"),
    "batches": ("yes", "yes", "yes"),
    "every feature of skin and sensor above": ("yes", "yes", "yes; film and liquid where there is a core"),
    "effects of a running sensor, `randomise`": ("yes", "yes", "yes"),
    'sensors as measured; `"random"`': ("eight; yes", "three; yes", "one, what the film conducts; no"),
    "`import`, `show`, `diagnose` of logs": ("yes", "yes", "no: logs are recognised by 19 or 24 electrodes"),
    "calibrate (forces alone)": ("yes", "yes", "yes"),
    "compare": ("yes", "no: the paper's configurations are of a BioTac", "no, likewise"),
    "data sets (`generate`, LeRobot), `estimate`": ("yes", "yes", "yes, where it has electrodes"),
    "`data import`, `resimulate`": ("yes", "yes", "no: recordings are recognised by 19 or 24 electrodes"),
    "models and states of MuJoCo (`data export --form mujoco`)": (
        "yes",
        "no: the model is a BioTac",
        "no, likewise",
    ),
    "diagnosis of data with poses; `next`": ("yes", "yes", "yes, in Python"),
    "flat presses against states (`diagnose --simulate`, `resimulate --poses fitted`)": (
        "yes",
        "yes, whose effects are those tried on the BioTac",
        "no",
    ),
    "what electrodes tell (`learn train` of recordings, `predict`)": ("yes", "yes", "yes, in Python"),
    "networks from skin to electrodes and back (`learn train` of sets)": (
        "yes",
        "yes",
        "yes, where it has electrodes",
    ),
    'signal "learned", "latent_projection", or a file of weights': (
        "yes",
        "a file of its own: those that ship are of the BioTac",
        "a file of its own, likewise",
    ),
    "`biotac data samples`": ("yes", "no: its sensor is a BioTac", "no, likewise"),
    "messages of ROS": ("biotac_sensors, tactile_msgs", "tactile_msgs", "tactile_msgs"),
}


@dataclasses.dataclass(frozen=True)
class Refused:
    """A path that refuses a feature: ValueError whose text matches `match` (a regular expression)."""

    match: str
    why: str


@dataclasses.dataclass(frozen=True)
class Absent:
    """A path on which there is nothing to ask for."""

    why: str


@dataclasses.dataclass(frozen=True)
class Feature:
    """A row of the table: a skin with the feature, and one without, whose forces differ.

    Attributes:
      name: in the table; where: what sets it.
      material, skin: changes of Material and SkinOptions with the feature.
      modulus: whether the elements' modulus varies with place.
      worlds: in what worlds differ: "material", or names of `skin.per_world.NAMES`. Such a row compares two
        worlds of one batch.
      base_material, base_skin: both with and without the feature.
      without: changes of both without it.
      cells: path -> Refused or Absent; all others do it.
    """

    name: str
    where: str
    material: dict = dataclasses.field(default_factory=dict)
    skin: dict = dataclasses.field(default_factory=dict)
    modulus: bool = False
    worlds: dict = dataclasses.field(default_factory=dict)
    base_material: dict = dataclasses.field(default_factory=dict)
    base_skin: dict = dataclasses.field(default_factory=dict)
    without: dict = dataclasses.field(default_factory=dict)
    cells: dict = dataclasses.field(default_factory=dict)

    def cell(self, path: str) -> Refused | Absent | None:
        """What a path has of it; None: it does it."""
        return self.cells.get(path)


_DRY = {"liquid": False}


def _elastic(name):
    return {"condensed": Refused(rf"the condensed tier is elastic.*{name}", "its compliance is made once")}


_COULOMB = {"condensed": Refused("the condensed tier knows Coulomb's law alone", "its contact has no other")}
_STILL = {"condensed": Refused("the condensed tier has no inertia", "its compliance has no mass")}
_LAW = "`options.skin.contact_law`"
_ONE = "one skin at a time"


def _of_worlds(**cells):
    """Cells of what differs by world: paths that have one world."""
    out = {path: Absent(_ONE) for path in ("CPU", "CUDA", "attach", "compare", "diagnose")}
    out["condensed"] = Absent(_ONE)
    return out | cells


_FITS = Absent("a fit's worlds differ in their materials; options that are fitted take a batch each")

FEATURES = (
    Feature("four-node tetrahedra", "`options.skin.element`", skin={"element": "linear"}, base_skin=_DRY,
            without={"skin": {"element": "quadratic"}}),
    Feature("ten-node tetrahedra", "`options.skin.element`", skin={"element": "quadratic"},
            without={"skin": {"element": "linear"}}),
    Feature("law corotational", "`material.law`", {"law": "corotational"},
            without={"material": {"law": "neo_hookean"}}),
    Feature("law svk", "`material.law`", {"law": "svk"}, without={"material": {"law": "linear"}}),
    Feature("law neo_hookean", "`material.law`", {"law": "neo_hookean"}),
    Feature("law linear", "`material.law`", {"law": "linear"}),
    Feature("liquid", "`options.skin.liquid`", skin={"liquid": True}, without={"skin": _DRY}),
    Feature("incompressible liquid", "`options.skin.bulk_modulus`", skin={"bulk_modulus": float("inf")},
            without={"skin": {"bulk_modulus": 1e6}}),
    Feature("filled skin", "`options.skin.fill_volume`", skin={"fill_volume": 2e-8}),
    Feature("filled to a pressure", "`options.skin.rest_pressure`", skin={"rest_pressure": 2e3}),
    Feature("less liquid than at rest", "`options.skin.fill_volume` < 0", skin={"fill_volume": -1e-8},
            cells={"condensed": Refused("needs a skin clear of its core at rest",
                                        "contact with the core begins from none")}),
    Feature("contact with the core", "`options.skin.core_contact`", skin={"core_contact": True},
            base_skin=_DRY, without={"skin": {"core_contact": False}}),
    Feature("friction", "`material.friction`, or a path's own", {"friction": 0.7},
            without={"material": {"friction": 0.0}}),
    Feature("implicit dynamics", "`options.skin.dynamics`", {"density": 1e4}, {"dynamics": "implicit"},
            without={"skin": {"dynamics": "quasistatic"}}, cells=_STILL),
    Feature("damping", "`options.skin.mass_damping, .stiffness_damping`",
            skin={"mass_damping": 400.0, "stiffness_damping": 2e-3}, base_skin={"dynamics": "implicit"},
            cells=_STILL),
    Feature("stress relaxation", "`material.prony`", {"prony": ((0.4, 0.02),)}, cells=_elastic("prony")),
    Feature("softening", "`material.mullins`", {"mullins": (2.0, 100.0, 0.3)}, cells=_elastic("mullins")),
    Feature("hysteresis", "`material.hysteresis`", {"hysteresis": ((0.5, 0.003),)},
            cells=_elastic("hysteresis")),
    Feature("stiffening", "`material.stiffening`", {"stiffening": 40.0}, cells=_elastic("stiffening")),
    Feature("modulus by element", "`options.modulus`", modulus=True),
    Feature("adhesion", _LAW, skin={"contact_law": {"adhesion": 0.3}}, cells=_COULOMB),
    Feature("adhesion with hysteresis", _LAW,
            skin={"contact_law": {"adhesion": 0.1, "adhesion_hysteresis": 4.0, "adhesion_range": 8e-5}},
            without={"skin": {"contact_law": {"adhesion": 0.1, "adhesion_range": 8e-5}}}, cells=_COULOMB),
    Feature("friction that depends on pressure", _LAW,
            skin={"contact_law": {"friction_exponent": 0.6, "friction_pressure": 3e4}}, cells=_COULOMB),
    Feature("how well a step is solved", "`options.skin.tolerance, .max_newton, .max_cg, .max_work`",
            skin={"tolerance": 0.1},
            cells={"condensed": Absent("a step of the condensed tier ends at 1e-4 of the residual and has "
                                       "limits of its own; these four are of the full tier and of the rest "
                                       "on a filling"),
                   "calibrate": Absent("a fit's derivatives need steps at least as good as "
                                       "`calibration.fit.TOLERANCE`: it takes the stricter")}),
    Feature("worlds differ in material", "a Material for each world; `vary`",
            base_material={"prony": ((0.4, 0.02),)},
            worlds={"material": ({"youngs_modulus": 1.2e6}, {"youngs_modulus": 1.8e6})}, cells=_of_worlds()),
    Feature("worlds differ in relaxation", "a Material for each world; `vary`",
            base_material={"prony": ((0.4, 0.02),)},
            worlds={"material": ({"prony": ((0.1, 0.02),)}, {"prony": ((0.6, 0.02),)})}, cells=_of_worlds()),
    Feature("worlds differ in adhesion", "`data.laws.set`, `worlds`, `vary`", worlds={"adhesion": (0.0, 0.3)},
            cells=_of_worlds(calibrate=_FITS)),
    Feature("worlds differ in the law of friction", "`data.laws.set`, `worlds`, `vary`",
            worlds={"friction_exponent": (0.0, 0.6)}, cells=_of_worlds(calibrate=_FITS)),
    Feature("worlds differ in fill", "`data.set_liquid`, `worlds`, `vary`",
            worlds={"fill_volume": (0.0, 2e-8)}, cells=_of_worlds(calibrate=_FITS)),
    Feature("worlds differ in the liquid's modulus", "`data.set_liquid`, `worlds`, `vary`",
            worlds={"bulk_modulus": (1e4, 4e5)}, cells=_of_worlds(calibrate=_FITS)),
    Feature("worlds differ in their elements' modulus", "`SkinData(modulus=)`, `worlds`",
            worlds={"modulus": ()}, cells=_of_worlds(calibrate=_FITS, generate=Refused(
                "cannot vary 'modulus'", "an interval says nothing of a map; vary youngs_modulus"))),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Sense:
    """A row of the table of the sensor: settings without which a channel reads otherwise.

    Attributes:
      name: in the table; where: what sets it.
      settings: of `attach`; geoms are named "touched" here.
      channel: that changes, by `least` counts at least in a press that slides.
      cells: path -> Refused; all others do it.
    """

    name: str
    where: str
    settings: dict
    channel: str
    least: float
    cells: dict = dataclasses.field(default_factory=dict)

    def cell(self, path: str) -> Refused | None:
        """What a path has of it; None: it does it."""
        return self.cells.get(path)


_NO_MODES = {
    "quick set": Refused("sets of the condensed tier know no vibration", "its contacts are not kept there")
}

SENSES = (
    Sense("presets of real sensors", '`sensor="epfl_f2"`', {"sensor": "epfl_f2"}, "electrodes", 30),
    Sense("random sensors", '`sensor="random"`', {"sensor": "random"}, "electrodes", 30),
    Sense("gains of single electrodes", '`randomise=["gain"]`', {"randomise": {"gain": 5.0}},
          "electrodes", 5),
    Sense("dead taxels", '`randomise=["dead"]`', {"randomise": {"dead": 40.0}}, "electrodes", 5),
    Sense("cross-talk", '`randomise=["crosstalk"]`', {"randomise": {"crosstalk": 6.0}},
          "electrodes", 5),
    Sense("gain of PDC", '`randomise=["pdc_gain"]`', {"randomise": {"pdc_gain": 40.0}}, "pdc", 2),
    Sense("relaxation, felt by PDC", '`randomise=["relax"]`', {"randomise": {"relax": 70.0}},
          "pdc", 1),
    Sense("warm-up", '`randomise=["warmup"]`', {"randomise": {"warmup": 1e3}}, "electrodes", 0.5),
    Sense("loss of liquid", '`randomise=["fluidloss"]`', {"randomise": {"fluidloss": 1e3}},
          "electrodes", 0.5),
    Sense("drift of counts", '`randomise=["drift"]`', {"randomise": {"drift": 40.0}},
          "electrodes", 5),
    Sense("constants of the film: electrodes' radius, residual film, place of X1 to X4", "`options.film`",
          {"options": {"film": {"residual_film": 3e-4, "electrode_radius": 9e-4}}}, "electrodes", 5),
    Sense("heat: TDC, TAC and electrodes by what is touched", "`thermal=`",
          {"thermal": {"touched": "steel at 3900"}}, "tac", 3),
    Sense("vibration: PAC by texture, slip and taps", "`textures=` (press, generate: `texture`)",
          {"textures": {"touched": {"roughness": 5e-5}}}, "pac", 10,
          cells=_NO_MODES),
)  # fmt: skip

_READINGS = (
    ("effects that measured data showed (`biotac diagnose`)", "`effects=` a sensor file, or a list",
     "attach, condensed (those of the rubber and the contact's law: full), batch, tasks; press and generate: "
     "`--effects`. Effects of the set-up are left out by name"),
    ("electrodes, PDC, TAC, TDC", "yes", "attach, condensed, batch, tasks, generate"),
    ("PAC", "all values of a frame, 22 of a BioTac and 31 of a BioTac SP",
     "attach, condensed, batch, tasks, generate, imported recordings, resimulate and the LeRobot export of "
     "all three; `readings.csv` of a press has the latest"),
    ("electrodes from a network", '`signal=` "latent_projection" (every BioTac skin), "learned" (the default '
     "skin), or a file of `biotac learn train`",
     "attach, condensed, batch, tasks, press and generate (`--signal`); diagnose: by physics alone"),
    ("place and force from electrodes by Lin, Fishel and Loeb's formula",
     "`sensor.WeightedElectrodes` of counts of any path",
     'tasks (`observe="estimated"`); force of other designs than the BioTac after `fitted`'),
    ("deformation and contact patch from electrodes", "`biotac learn predict`: latent_projection, or inverse "
     "with force", "recordings, `readings.csv` of a press"),
    ("the skin under a recording", "`biotac data resimulate`: recorded poses, or a plate's fitted ones",
     "full tier, either device; everything of the skin's table that generate has but `vary`; no heat or "
     "vibration"),
    ("gains and couplings of another sensor, from its touches",
     "`biotac learn judge --new-sensor SET --sensor FILE.yaml`",
     "labelled sets of the BioTac; the sensor runs wherever `effects=` does"),
    ("what electrodes tell (force, place, novelty)", "`biotac learn train`, `biotac learn predict`",
     "recordings and data sets"),
    ("impedance of the electrodes", "yes", "generate, diagnose"),
    ("force, pressure", "yes", "all; calibrate and compare: force and displacement alone"),
    ("effects inside the skin", "relax, creep, mullins, hyster, stiffen, inhomog, adhesion, fric_load, "
     "fluidloss, asper", "diagnose with `--in-skin`, tier full, either device; the other paths have their "
     "materials, contact laws and fill"),
    ("numbers of effects that follow what a recording shows", "`film`, `liquid`, `more` of relaxation, creep "
     "and hysteresis, `sink` of lost liquid, `of_pdc` of latency",
     "diagnose alone: a sensor that runs with `effects=` leaves them out, with a warning that names them"),
    ("`joining` of adhesion, `through` of stiffening", "yes", "diagnose; a sensor that runs with `effects=` "
     "has the first as the contact's work of adhesion, the second as stiffening of the rubber"),
)  # fmt: skip

# How `mj_step` and `mujoco_warp.step` find the force of a skin and the motion of bodies together.
_COUPLING = (
    ("`status` of a step: tier, steps without equilibrium, rounds, fraction of the bodies' motion that was "
     "reached, fraction of the push on a body that was withheld",
     "attach, condensed, batch; generate keeps `converged`"),
    ("Two-way, skin and bodies are solved in rounds until they agree. A skin that cannot be solved where the "
     "bodies go is solved on the way there. Core, nail and clamp are solid. No blow gives back more energy "
     "than it put in", "attach, condensed, batch"),
    ("`options.threads`: the skins of a scene are solved side by side, the same to the bit",
     "attach, condensed; refused one-way and in batches, whose worlds are abreast anyway"),
    ("Bodies that bounce lose what the rubber loses: loss factor 0.2 at 50 Hz, another by `options.loss`",
     "attach, condensed, batch; refused one-way; skins with inertia damp by their own step"),
    ("`options.rounds` says how many rounds a step may take",
     "attach, condensed, batch; refused one-way, and where the motion is given (press, generate, "
     "resimulate)"),
    ("The round that came closest counts. At first touch a skin lends no energy",
     "attach, condensed, batch"),
    ("A round that went too far goes back. Where MuJoCo's solver is a dual one (PGS, noslip) the equilibrium "
     "is found with its Newton solver and acts as forces", "attach, condensed; mujoco_warp has no PGS"),
    ("A skin at rest is first solved where a geom begins to touch it, and then as deep as the core allows. "
     "The energy in a skin into which a body was put is unknown until an equilibrium is found",
     "attach (on the CPU), condensed, batch; attach on CUDA: as deep as the force on the way allows"),
    ("Where a body is too deep for any skin to fit, the skin goes along the core with it", "condensed"),
    ("All solves of a step share one bound on their work. After a step without equilibrium in which no body "
     "could give way, or another BioTac's skin did, the next one may do four times as much",
     "attach, condensed; batch: bounds of its own, by iterations"),
    ("A try that comes no nearer has 40 iterations before it is given up. Where friction makes the tangent "
     "unsymmetric, the preconditioner's answer is taken as the step",
     "the full tier on all its paths; condensed solves such contact directly"),
    ("A skin that could not move for three steps begins anew from rest", "attach, condensed, batch"),
    ("Bodies move with the accelerations of MuJoCo's integrator (velocity products, joint damping), found "
     "for all skins of a world together", "attach, condensed, batch"),
    ("With RK4 the skin and MuJoCo's contacts, limits and friction on what it touches are solved once a "
     "step, and their forces act in all stages", "attach, condensed; refused in batches"),
    ("Energy is counted along the way that bodies went, along arcs where joints turn",
     "attach, condensed, batch"),
    ("Several skins on one body search for their equilibrium together",
     "attach, condensed; batch: each by itself"),
    ("`<flag contact=\"disable\"/>`: the skin touches nothing either",
     "attach, condensed, looked at in every step; batch, when it is attached"),
    ("Core, nail and clamp have the skin's friction",
     "attach, condensed, `batch.attach`; with `batch.make` they meet in the other simulator"),
    ("Where a world would gain energy however much is withheld, its skins do not act in that step",
     "attach, condensed, batch"),
    ("Where the contact's force jumps (an edge of a mesh) a skin stays that has come as near to it as it "
     "can", "condensed, on all its paths"),
    ("A skin whose bodies stay within 2 nm of where it was solved is not solved again, nor its film",
     "attach, condensed; solved in batches and where coupling is one-way"),
    ("Bodies that cannot touch a skin do not have it solved again",
     "condensed: attach, batches; in the full tier all bodies near the BioTac count"),
)  # fmt: skip


_NEIGHBOURS = (
    ("`mujoco.rollout`, `mujoco.batch`", "the engine plugin, on any number of threads, to the bit",
     "`examples/many_at_once.py`"),
    ("mjlab", "`neighbours.mjlab.BioTacSensorCfg` with the interface of its `SensorCfg` and `Sensor`: the "
     "batch inside `mujoco_warp.step`, two-way; on CUDA `sim.create_graph()` once more",
     "mjlab 1.6.0 on a CPU; on a GPU not at all"),
    ("MJX, Brax, MuJoCo Playground (JAX)", "`mjx.put_model`, `make_data`, `step`, `forward` and `readings`: "
     "the batch inside `mujoco_warp.step`, two-way, as one call of JAX's; jit, scan and vmap; gradients are "
     "refused by name; settings are the same in all worlds, but for the seed",
     "JAX 0.9 and 0.10, Brax 0.14 on a CPU; on an H200 in part"),
    ("Isaac Lab", "`neighbours.isaaclab.BioTacSensor` with the methods of its `SensorBase`, no subclass: "
     "`batch.make` beside its physics, told poses, forces handed back explicitly, one step late; put into "
     "`scene.sensors`", "a double of its calls on the CPU, not in Isaac Lab"),
    ("ROS 1 and 2", "`biotac recording import` and `export`: bags with `biotac_sensors` or `tactile_msgs`; "
     "`biotac recording record` from running topics, `neighbours.ros.Publisher` to them", "bags: `rosbags`; "
     "live: doubles of `rclpy` and `rospy`, not ROS"),
)  # fmt: skip


_TRAVEL = """\
`material` is a preset's name, a dict of Material's fields, a `.json` file of them or a Material; `options` is
`{"skin": {...}, "modulus": [...]}`, in Python a dict (with SkinOptions, a ContactLaw or arrays in it, if you
like), on the command line `--options`, JSON or a file of it. `modulus` is a factor for each element, a `.npy`
file of them or, in Python, a function of positions. On paths with a sensor `options` may have "film" too.
`attach` writes all of it into the model as JSON. `material="calibrated"` is the one name for what was fitted
to real sensors (docs/lab/real_match.md), rubber, filling and electrodes, on every path.

Rubber that relaxes, and inertia, take their time step from: `mj_step`'s timestep (attach, batch, press),
`time_s` of an indentation (calibrate, compare; planned ones have 20 ms a sample), 1 / rate (generate), `time`
of a trajectory (diagnose), shared among the steps between two rows. `skin.step` takes dt, a number or one for
each world. The interval before the first row is as long as the one after it.

`batch.attach(worlds={...})` and `skin.per_world.make_worlds` take (nworld,) numbers by name; `biotac data
generate --vary` draws these numbers, and the material's, anew for each interaction and stores them in its
parameters."""


# What `biotac_mj.differentiable` has gradients of: by what, and what is refused.
_GRADIENTS = [
    ("poses of geoms, pose of the core", "`press(pos, quat, core_pos, core_quat)`", "yes"),
    ("Young's modulus, Poisson's ratio, friction, contact stiffness", "`press`, `calibrate`", "yes"),
    ("fill volume, bulk modulus", "`press`, `calibrate`", "yes; of an incompressible liquid the fill alone"),
    ("four and ten nodes, all laws, stiffening, modulus by element", "`Skin`", "yes"),
    ("planes, spheres, capsules, cylinders, boxes, meshes; contact with the core", "`Skin`", "yes"),
    ("nodes, wrench, pressure of every step", "`Pressed`", "yes, backwards and forwards"),
    ("electrodes and PDC without rounding, by nodes, pressure and the film's constants", "`impedance`, "
     "`electrode_counts`, `pdc_counts`", "yes; not what acts in time (warm-up, drift, low-pass, latency)"),
    ("fits: slopes by these gradients, else by differences, said in the output",
     "`biotac lab calibrate`, `biotac lab compare`", "yes; not the refits of `diagnose`"),
    ("place and force of a contact from electrodes, with intervals", "`biotac lab estimate`, `Estimator`",
     "one geom that comes along the normal, tilted to first order; its drag in presses of the simulator; "
     "labelled touches of the sensor by `--known`"),
    ("kinks and jumps: first touch, stick and slip, rubber's memory, sharp edges, no equilibrium",
     "`Pressed.changes`, `Pressed.counts`", "counted in every step"),
    ("first touch, and the change from stick to slip, smoothed", "`press(smoothing=)`",
     "yes, of what touches the skin; contact with the core keeps its kinks"),
    ("several worlds", "`press` with a leading nworld", "yes, one after another on the CPU"),
    ("several worlds at once, on the CPU or CUDA", "`press(together=)`",
     "dry and elastic, by poses, friction and the law's constants, backwards and forwards; refused by name: "
     "liquid, prony, mullins and hysteresis, rest_nodes, smoothing"),
    ("rubber with prony, mullins or hysteresis", "`press(dt=, prony=, mullins=, hysteresis=)`, `calibrate`",
     "yes; fits have the law's constants alone; by time steps no gradient"),
    ("contact_law; implicit dynamics", "`Skin`", "refused by name"),
    ("a skin filled to rest_pressure", "`Skin`", "refused: it says which fill_volume is the same"),
    ("ellipsoids", "`Skin`", "refused by name"),
    ("rest positions of nodes: shape and thickness", "`press(rest_nodes=...)`",
     "yes, with contact on the core and `impedance(rest_nodes=)`; the core stays, and what can meet it"),
    ("temperatures, TDC and TAC without rounding, by areas, forces, the first state, what bodies are of and "
     "the sensor's constants", "`temperatures`, `tdc_counts`, `tac_counts`",
     "yes, one sensor; not by the skin's nodes, nor TAC's low-pass; areas have kinks"),
    ("tensors on CUDA", "`press`, `impedance`, `temperatures`",
     "brought to the CPU, where all is computed but for `press(together=)`, and gradients back"),
    ("all of these for JAX: `grad`, `jacrev`, `jit`, `vmap`", "`for_jax`",
     "backwards alone, computed on the CPU; worlds of `vmap` one after another"),
    ("steps of MuJoCo with BioTacs in them: states, nodes, wrenches, pressure, MuJoCo's sensors; by the "
     "state at the beginning, controls, applied forces, mocap bodies", "`rollout`",
     "yes, backwards; MuJoCo's own part by differences; refused: condensed, CUDA, another's skin, RK4"),
    ("PAC", "", "there is nothing to ask"),
]  # fmt: skip


_BOTH = (
    '`batch.attach` and `batch.make` with `tier="condensed"` have what the column condensed has, and worlds '
    "that differ in\nYoung's modulus, friction and the liquid's modulus; other differences are refused\n"
    "(`tests/test_skin_condensed_worlds.py`).\n\n"
)
_SKIN_ON_SKIN = (
    "Skins of two BioTacs meet (`tests/test_skin_on_skin.py`) in attach, condensed and batch, where neither "
    "names its `geoms`.\nThe other paths have one BioTac; `skin.step` takes geoms of type skin with "
    "`GeomSet(own=)`, and gradients refuse them.\n\n"
    "MuJoCo's own `<force>`, `<torque>`, `<touch>`, `<contact>`, `cfrc_ext` and `cfrc_int` feel a two-way "
    "skin in attach, condensed and batch ([how](lab/coupling.md#mujocos-own-force-sensors)).\n"
    "Flexes that collide with a BioTac are refused when the model is compiled (`tests/test_true_contact.py`)."
)


def markdown() -> str:
    """`docs/features.md`."""
    lines = [
        "# What skin and sensor can do, by path",
        "",
        "Made by `python scripts/features.py > docs/features.md` from the table there. "
        "`tests/test_features.py`",
        "walks it: every yes runs a small press whose force must change, every no must raise what is said "
        "here.",
        "",
    ]
    lines += [f"- **{path}**: {text}" for path, text in PATHS.items()]
    lines += ["", f"| feature | set by | {' | '.join(PATHS)} |", f"|---|---|{'---|' * len(PATHS)}"]
    notes, absent = [], []
    for feature in FEATURES:
        cells = []
        for path in PATHS:
            cell = feature.cell(path)
            if cell is None:
                cells.append("yes")
                continue
            kept = notes if isinstance(cell, Refused) else absent
            if cell not in kept:
                kept.append(cell)
            number = kept.index(cell) + 1
            cells.append(f"no ({number})" if kept is notes else f"- ({'abcdefgh'[number - 1]})")
        lines.append(f"| {feature.name} | {feature.where} | {' | '.join(cells)} |")
    lines += ["", _BOTH + _SKIN_ON_SKIN]
    lines += ["", "Refused, a ValueError that says what to do instead:"]
    lines += [f"{i + 1}. `{one.match}`: {one.why}." for i, one in enumerate(notes)]
    lines += ["", "Nothing to ask for:"]
    lines += [f"- ({'abcdefgh'[i]}) {one.why}." for i, one in enumerate(absent)]
    lines += ["", "## The sensor", ""]
    lines.append("`tests/test_features_senses.py` walks this table: a press that slides must read otherwise.")
    lines += ["", *(f"- **{path}**: {text}" for path, text in SENSE_PATHS.items())]
    lines += ["", f"| sense | set by | {' | '.join(SENSE_PATHS)} |"]
    lines.append(f"|---|---|{'---|' * len(SENSE_PATHS)}")
    refused = []
    for sense in SENSES:
        cells = []
        for path in SENSE_PATHS:
            cell = sense.cell(path)
            if cell is not None and cell not in refused:
                refused.append(cell)
            cells.append("yes" if cell is None else f"no ({refused.index(cell) + 1})")
        lines.append(f"| {sense.name} | {sense.where} | {' | '.join(cells)} |")
    lines += ["", *(f"{i + 1}. `{one.match}`: {one.why}." for i, one in enumerate(refused))]
    lines += [
        "",
        "`diagnose` fits the same classes of effects (`biotac_mj/effects`) to data, and leaves heat and",
    ]
    lines.append("vibration out; calibrate and compare have no sensor.")
    lines += ["", "## Designs", "", _DESIGN, "", f"| what | {' | '.join(DESIGN_COLUMNS)} |"]
    lines.append(f"|---|{'---|' * len(DESIGN_COLUMNS)}")
    for what, cells in DESIGN_ROWS.items():
        lines.append(f"| {what} | {' | '.join(cells)} |")
    lines += ["", "## Readings", "", "| reading | what | paths |", "|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in _READINGS]
    lines += ["", "## How skin and bodies are solved together", "", "| what | paths |", "|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in _COUPLING]
    lines += [
        "",
        "## Gradients",
        "",
        "`tests/test_differentiable.py` and `test_differentiable_film.py` hold them ",
    ]
    lines[-1] += "against differences (docs/lab/differentiable.md)."
    lines += ["", "| of, or by | where | there |", "|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in _GRADIENTS]
    lines += ["", "## Beside other software", "", "| what | how | tried in |", "|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in _NEIGHBOURS]
    lines += ["", "## How options travel", ""]
    lines.append(_TRAVEL)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(markdown(), end="")
