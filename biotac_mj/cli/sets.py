"""The verbs `biotac data generate`, `import` and `export`."""

import argparse

from ..arguments import SEED, add_ray, output_folder, quantity, real, whole
from .common import add_results, add_sensor, add_skin, add_verb
from .names import INTERACTIONS, OBJECTS


def add_generate(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    verb = add_verb(
        verbs,
        "generate",
        "data.verbs.generate_verb",
        "Make a synthetic data set of random interactions; continues an interrupted run.",
    )
    verb.add_argument("--count", type=whole(1, 10_000_000), default=2600, help="number of interactions")
    verb.add_argument("--steps", type=whole(8, 2000), default=20, help="time steps of each, at least 8")
    verb.add_argument(
        "--rate", type=real(1e-3, 4400.0), default=20.0, metavar="HZ", help="rate of the time steps"
    )
    text = "number with counts of the synthetic measured sensor too (default: 359)"
    verb.add_argument("--labelled", type=whole(0, 10_000_000), help=text)
    text = f"what touches: {', '.join(OBJECTS)}, geom:TYPE:SIZE[,SIZE...] or mesh:FILE"
    verb.add_argument("--objects", nargs="+", default=list(OBJECTS), metavar="NAME", help=text)
    text = "how it moves"
    verb.add_argument(
        "--kinds", nargs="+", default=list(INTERACTIONS), choices=INTERACTIONS, metavar="KIND", help=text
    )
    text = "element of the skin (default: the material's, or the mesh's)"
    verb.add_argument("--element", choices=("linear", "quadratic"), help=text)
    verb.add_argument(
        "--batch", type=whole(1, 100_000), default=160, help="most worlds in a batch; a shard holds one batch"
    )
    text = "the same for batches with the synthetic measured sensor"
    verb.add_argument("--measured-batch", type=whole(1, 100_000), default=90, help=text)
    verb.add_argument("--measured-seed", type=SEED, default=0, help="number of the synthetic measured sensor")
    verb.add_argument(
        "--measured-skin", help="mesh of the synthetic measured sensor (default: fine, of the skin's design)"
    )
    text = (
        "processes: on the CPU each makes whole shards, beside GPUs they compute readings (default: one "
        "per core)"
    )
    verb.add_argument("--workers", type=whole(0, 1024), help=text)
    text = (
        "random values per interaction, JSON or a file of it: "
        '{"youngs_modulus": [1e6, 2e6], "adhesion": [0, 0.1]}'
    )
    verb.add_argument("--vary", metavar="JSON", help=text)
    add_skin(verb, seed="of all random numbers: the same seed gives the same files on the same device")
    add_sensor(verb, "the objects are")
    add_ray(verb)
    add_results(verb, "out/set", "folder of the set", "generate.json")


def add_data(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb to the command line."""
    from ..recordings.verbs import add_load_arguments

    verb = add_verb(
        verbs,
        "import",
        "data.verbs.import_verb",
        "Read recordings of real sensors, any file of `biotac recording import`, into a set.",
    )
    verb.add_argument("files", nargs="+", metavar="FILE", help="each becomes a shard")
    verb.add_argument("--force", metavar="FILE", help="forces row by row, text of 3 columns [N]")
    text = "split into interactions of this length (and at gaps of half a second)"
    verb.add_argument("--block", type=quantity("time", 1e9, 1e-3), metavar="TIME", help=text)
    verb.add_argument(
        "--objects", nargs="+", metavar="NAME", help="NVIDIA's files: names of indenter types 0, 1, ..."
    )
    add_load_arguments(verb)
    verb.add_argument("--seed", type=SEED, default=0, help="seed of the split by interaction")
    folder = output_folder(new="shard-00000.h5")
    verb.add_argument("--out", type=folder, required=True, metavar="DIR", help="folder of the set")
    verb = add_verb(
        verbs,
        "export",
        "data.verbs.export_verb",
        "Write a set in the layout of LeRobotDataset v3.0, or as models, states and sensor data of MuJoCo.",
    )
    verb.add_argument("set", metavar="SET", help="folder of shards")
    verb.add_argument("--form", choices=("lerobot", "mujoco"), default="lerobot", help="layout of the files")
    text = "measured counts of interactions that have them, instead of simulated ones"
    verb.add_argument("--measured", action="store_true", help=text)
    text = "rate of LeRobot's frames, which hold the nearest rows (default: the set's)"
    verb.add_argument("--rate", type=real(0.1, 1e4), metavar="HZ", help=text)
    folder = output_folder(new="")
    verb.add_argument("--out", type=folder, required=True, metavar="DIR", help="folder to make")
    verb.add_argument("--quiet", action="store_true", help="no progress bar")
