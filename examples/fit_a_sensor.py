"""A sensor's own numbers from a recording, by gradient: a robot presses a ball into a BioTac and slides it
on a path that is known, and records force and electrodes. Which modulus, which filling and which film between
skin and core read like that? Needs the extra `learning` (PyTorch); a minute: python examples/fit_a_sensor.py

The recording is synthetic: the same simulation with other numbers, with noise. Gauss and Newton's method has
its slopes forwards, through rubber, liquid, contact and film; they also say how well each number is known."""

import numpy as np
import torch
import torch.autograd.forward_ad as forward

from biotac_mj import differentiable
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.film import FilmConduction

# name, unit, what the synthetic sensor has, where the search begins
NUMBERS = (
    ("Young's modulus", "MPa", 1.1, 1.5),
    ("filling", "mm^3", 15.0, 5.0),
    ("film on the core", "um", 70.0, 50.0),
)
FORCE_NOISE, COUNT_NOISE = 5e-3, 4.0  # [N], [counts]
READ = slice(2, None, 2)  # steps that the recording has


def path() -> tuple[torch.Tensor, torch.Tensor]:
    """(9, 1, 3) [m] and (9, 1, 4) of the ball: clear of the skin, down, along."""
    down = torch.tensor([-2.0, 0.3, 0.6, 0.9, 1.2, 1.4, 1.4, 1.4, 1.4]).double()
    along = torch.tensor([0.0, 0, 0, 0, 0, 0, 0.5, 1.0, 1.5]).double()
    way = torch.stack([along - 11, down - 11.4, 0 * down], 1)
    return 1e-3 * way[:, None], torch.tensor([1.0, 0, 0, 0]).double().expand(len(way), 1, 4)


class Simulation:
    """What a sensor of such numbers records, over the noise: (k,) of (3,)."""

    def __init__(self, skin: str):
        geometry = load_skin(skin)
        self.skin = differentiable.Skin(geometry, types=["sphere"], sizes=[[0.0035]])
        self.film = FilmConduction(geometry)

    def __call__(self, numbers: torch.Tensor) -> torch.Tensor:
        modulus, filling, film = numbers
        pressed = differentiable.press(
            self.skin, *path(), youngs_modulus=1e6 * modulus, fill_volume=1e-9 * filling
        )

        def read(nodes):
            return differentiable.impedance(self.film, nodes, residual_film=1e-6 * film)

        rest = read(pressed.nodes[0])
        counts = [differentiable.electrode_counts(read(nodes), rest) for nodes in pressed.nodes[READ]]
        force = pressed.wrench[READ, 0, :3]
        return torch.cat([(force / FORCE_NOISE).ravel(), torch.stack(counts).ravel() / COUNT_NOISE])

    def slopes(self, numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(k,) and its slopes (k, 3)."""
        columns = []
        for axis in torch.eye(len(numbers)).double():
            with forward.dual_level():
                value, slope = forward.unpack_dual(self(forward.make_dual(numbers, axis)))
            columns.append(slope)
        return value, torch.stack(columns, 1)


def main(skin: str = "coarse", rounds: int = 5, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The numbers (3,) that were found, and their standard errors."""
    simulation = Simulation(skin)
    truth, found = (torch.tensor([row[k] for row in NUMBERS]).double() for k in (2, 3))
    recorded = simulation(truth)
    recorded = recorded + torch.randn(recorded.shape, generator=torch.Generator().manual_seed(seed)).double()
    for turn in range(rounds):
        value, slopes = simulation.slopes(found)
        missed = recorded - value
        print(f"{turn}: {found.numpy().round(3)}, off by {missed.square().mean().sqrt():.2f} of the noise")
        move = torch.linalg.lstsq(slopes, missed[:, None]).solution[:, 0]
        found = found + move.clamp(-0.4 * found, 0.7 * found)
    error = torch.linalg.inv(slopes.T @ slopes).diagonal().sqrt()
    for (name, unit, true, _), value, off in zip(NUMBERS, found.tolist(), error.tolist()):
        print(f"{name}: {value:.3f} +- {off:.3f} {unit} (the sensor has {true})")
    return found.numpy(), error.numpy()


if __name__ == "__main__":
    main()
