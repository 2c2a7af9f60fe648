"""Policies: a small network from what is observed to actions, in a file with a card."""

import json
import pathlib
import re

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from ...files import replacing
from ...reading import reading

_HIDDEN = (256, 128)  # units
_LEAST = 0.1  # deviation of actions in learning
_CLIP = 10.0  # deviations from the mean beyond which an observation is cut


class Network(torch.nn.Module):
    """A perceptron that normalises its input by mean and variance.

    Args:
      nseen, nout: widths. hidden: units of the layers between.
    """

    def __init__(self, nseen: int, nout: int, hidden: tuple[int, ...] = _HIDDEN):
        super().__init__()
        for name, start in (("mean", torch.zeros(nseen)), ("square", torch.ones(nseen))):
            self.register_buffer(name, start)
        self.register_buffer("count", torch.zeros(()))
        widths, layers = (nseen, *hidden), []
        for before, after in zip(widths[:-1], widths[1:], strict=True):
            layers += [torch.nn.Linear(before, after), torch.nn.ELU()]
        self.layers = torch.nn.Sequential(*layers, torch.nn.Linear(widths[-1], nout))

    def update_statistics(self, seen: torch.Tensor, alike: torch.Tensor | None = None) -> None:
        """Adds observations (n, nseen) to the mean and variance that normalise them; those with one number in
        alike, (nseen,) of int, have one variance."""
        self.count += len(seen)
        weight = len(seen) / self.count
        self.mean += weight * (seen.mean(0) - self.mean)
        self.square += weight * (seen.square().mean(0) - self.square)
        if alike is not None:
            variance = self.square - self.mean.square()
            total = torch.zeros(int(alike.max()) + 1, device=seen.device).index_add_(0, alike, variance)
            self.square = (total / alike.bincount().clamp(min=1))[alike] + self.mean.square()

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        deviation = (self.square - self.mean.square()).clamp(min=1e-6).sqrt()
        return self.layers(((seen - self.mean) / deviation).clamp(-_CLIP, _CLIP))


class Policy(Network):
    """Actions (n, nout) from inputs; `explore` is the deviation in learning."""

    def __init__(self, nseen: int, nout: int, hidden: tuple[int, ...] = _HIDDEN, explore: float = 0.5):
        super().__init__(nseen, nout, hidden)
        self.log_std = torch.nn.Parameter(torch.full((nout,), explore).log())

    @property
    def explore(self) -> torch.Tensor:
        return self.log_std.exp().clamp(min=_LEAST)


def save_policy(path: pathlib.Path | str, policy: Policy, card: dict) -> None:
    """Writes a safetensors file, weights in half precision; card: what it saw and how it did, in the
    metadata."""
    tensors = {
        name: (value.half() if name.startswith("layers.") else value).detach().cpu().contiguous()
        for name, value in policy.state_dict().items()
    }
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata={"card": json.dumps(card)})


def read_card(path: pathlib.Path | str) -> dict:
    """The card of a file.

    Raises:
      FileNotFoundError: no such file. ValueError: it is no policy.
    """
    with reading(path, "policy", _MAKE), safe_open(path, "pt") as file:
        card = (file.metadata() or {}).get("card")
    if card is None:
        raise ValueError(f"{path} is no policy: {_MAKE}")
    return json.loads(card)


def load_policy(path: pathlib.Path | str, device: str = "cpu") -> tuple[Policy, dict]:
    """The policy and its card.

    Raises:
      FileNotFoundError: no such file. ValueError: it is no policy.
    """
    card = read_card(path)
    with safe_open(path, "pt", device=device) as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    widths = [len(value) for name, value in tensors.items() if re.fullmatch(r"layers\.\d+\.bias", name)]
    policy = Policy(len(tensors["mean"]), len(tensors["log_std"]), widths[:-1]).to(device)
    policy.load_state_dict(tensors)
    return policy, card


_MAKE = "make one with `python -m biotac_mj.tasks.batched.training TASK --out FOLDER`"
