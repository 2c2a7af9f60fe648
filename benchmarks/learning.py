"""Time of one inference: deformed skin -> 19 electrodes, by the default model and by the paper's network.

    python benchmarks/learning.py --weights forward-trajectory.safetensors [--device cuda] [--json FILE]

On the CPU one thread and one sensor; processor time is given too, since a wall clock means little on a busy
machine. On a GPU batches. The paper's network is timed with random weights: they do not change its time."""

import argparse
import functools
import statistics
import time

import torch
from records import write_json

from biotac_mj.geometry import load_skin
from biotac_mj.learning.networks.electrode_vae import ElectrodeVAE
from biotac_mj.learning.networks.hierarchy import build_hierarchy
from biotac_mj.learning.networks.mesh_vae import MeshVAE
from biotac_mj.learning.training.config import LearningConfig
from biotac_mj.learning.training.paper import LatentProjection
from biotac_mj.learning.weights import load_forward, shipped


def measure(work, device, repeats):
    """Median wall clock and mean processor time of work() [s]."""
    for _ in range(3):
        work()
    wall = []
    begun = time.process_time()
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        wall.append(time.perf_counter() - start)
    return statistics.median(wall), (time.process_time() - begun) / repeats


def in_parts(work, u, average, parts):
    for i in range(0, len(u), parts):
        work(u[i : i + parts], average)


@torch.no_grad()
def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", help="default: the package's")
    parser.add_argument("--skin", default="default")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--paper", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--json")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    geometry, config = load_skin(args.skin), LearningConfig()
    model = load_forward(args.weights or shipped("forward"), geometry).to(args.device)
    networks = {
        f"default ({model.meta['model']}, {model.meta['members']} members)": lambda u, a: model.log_change(
            u, a, 0.01
        )
    }
    if args.paper:
        levels = build_hierarchy(geometry.vert, geometry.tets, config.mesh_factors)
        paper = LatentProjection(MeshVAE(levels), ElectrodeVAE(), config).eval().to(args.device)
        networks["paper's latent projection"] = lambda u, a: paper(u)
    rows = []
    print(f"{'':<44}{'sensors':>8}{'us per sensor':>15}{'processor us':>14}   on {args.device}")
    for name, work in networks.items():
        for n in args.batches if args.device == "cuda" else [1]:
            u = 0.05 * torch.randn(n, geometry.nvert, 3, device=args.device)
            average = torch.zeros(n, *model.memory, device=args.device) if model.window else None
            parts = 256 if name.startswith("paper") else n  # what fits beside its activations
            wall, cpu = measure(
                functools.partial(in_parts, work, u, average, parts), args.device, 50 if n == 1 else 20
            )
            rows.append(
                {
                    "network": name,
                    "sensors": n,
                    "us_per_sensor": 1e6 * wall / n,
                    "processor_us_per_sensor": 1e6 * cpu / n,
                }
            )
            print(f"{name:<44}{n:>8}{1e6 * wall / n:>15.1f}{1e6 * cpu / n:>14.1f}")
    if args.json:
        about = {
            "device": torch.cuda.get_device_name() if args.device == "cuda" else "cpu, one thread",
            "skin": args.skin,
            "torch": torch.__version__,
        }
        write_json(args.json, about | {"rows": rows})
    return rows


if __name__ == "__main__":
    main()
