"""Proximal policy optimisation (Schulman et al. 2017) for worlds that step together, with a critic that sees
what the policy does not, and at first with a teacher that knows what the policy does not: the student acts,
and is told what the teacher would have done (Ross et al. 2011)."""

import dataclasses

import torch

from .policy import Network, Policy

__all__ = ["Learner", "Numbers"]


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Of the method.

    Attributes:
      steps: decisions between updates. epochs, parts: of an update.
      gamma, lam: discount of a decision, and of generalised advantages. clip: of ratios of densities.
      rate: of learning at first; it is adapted so that an update changes the policy by `divergence` [nat].
      norm: of gradients at most.
      taught: part of the time of learning in which the teacher counts, from wholly to not at all.
    """

    steps: int = 8
    epochs: int = 5
    parts: int = 4
    gamma: float = 0.95
    lam: float = 0.9
    clip: float = 0.2
    rate: float = 1e-3
    divergence: float = 0.03
    norm: float = 1.0
    taught: float = 0.5


class Learner:
    """A policy that learns.

    Args:
      nseen, nknown, nout: widths of what the policy sees, the critic knows, and of actions.
      seed: of networks and exploration. device: of torch.
    """

    def __init__(self, nseen: int, nknown: int, nout: int, seed: int, device: str, numbers: Numbers):
        self.numbers, self._device = numbers, device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.policy, self.critic = Policy(nseen, nout).to(device), Network(nknown, 1).to(device)
        self._draw = torch.Generator(device).manual_seed(seed)
        self._optimiser = torch.optim.Adam(
            [*self.policy.parameters(), *self.critic.parameters()], lr=numbers.rate
        )
        self._kept = []

    @torch.no_grad()
    def act(
        self, seen: torch.Tensor, known: torch.Tensor, taught: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Actions (n, nout) with exploration; taught: (n, nout) of the teacher there, None: there is none."""
        self.policy.watch(seen)
        self.critic.watch(known)
        mean, explore = self.policy(seen), self.policy.explore.detach().clone()
        noise = torch.randn(mean.shape, generator=self._draw, device=self._device)
        actions = mean + explore * noise
        log = _log_density(mean, explore, actions)
        value = self.critic(known)[:, 0]
        taught = torch.zeros_like(actions) if taught is None else taught
        self._kept.append([seen, known, actions, log, mean, explore.expand_as(mean), taught, value])
        return actions

    def record(self, reward: torch.Tensor, done: torch.Tensor, over: torch.Tensor) -> None:
        """What the last actions brought (n,): reward, whether the episode ended, whether by time alone."""
        kept = self._kept[-1]
        # what would have come after an episode's time is worth what its last state was
        kept += [reward + self.numbers.gamma * kept[7] * over, done.float()]

    def update(self, known: torch.Tensor, teaching: float = 0.0) -> None:
        """Learns from what was recorded.

        Args:
          known: (n, nknown) after the last decision. teaching: how much the teacher counts, 0 to 1.
            Where he does the rate of learning stays as it is.
        """
        s = self.numbers
        seen, knew, actions, log, mean, explore, taught, value, reward, done = (
            torch.stack(column) for column in zip(*self._kept, strict=True)
        )
        self._kept = []
        with torch.no_grad():
            after = torch.cat([value[1:], self.critic(known)[None, :, 0]])
            gain = reward + s.gamma * (1 - done) * after - value
            advantage, last = torch.zeros_like(gain), torch.zeros_like(gain[0])
            for k in reversed(range(len(gain))):
                last = advantage[k] = gain[k] + s.gamma * s.lam * (1 - done[k]) * last
            wanted = advantage + value
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        columns = (seen, knew, actions, log, mean, explore, taught, wanted, advantage)
        rows = [column.flatten(0, 1) for column in columns]
        for _ in range(s.epochs):
            order = torch.randperm(len(rows[0]), generator=self._draw, device=self._device)
            for part in order.chunk(s.parts):
                self._improve(teaching, *(row[part] for row in rows))

    def _improve(self, teaching, seen, known, actions, log, mean, explore, taught, wanted, advantage):
        s = self.numbers
        new_mean, new_explore, now = self.policy(seen), self.policy.explore, self.critic(known)[:, 0]
        with torch.no_grad():
            ratio = explore / new_explore
            divergence = -ratio.log() + 0.5 * (
                ratio.square() + ((new_mean - mean) / new_explore).square() - 1
            )
            if not teaching:
                self._adapt(float(divergence.sum(-1).mean()))
        ratio = (_log_density(new_mean, new_explore, actions) - log).exp()
        gain = torch.minimum(ratio * advantage, ratio.clamp(1 - s.clip, 1 + s.clip) * advantage)
        off = (now - wanted).square()
        loss = off.mean() - (1 - teaching) * gain.mean()
        if teaching:
            loss = loss - teaching * _log_density(new_mean, new_explore, taught).mean()
        self._optimiser.zero_grad()
        loss.backward()
        for network in (self.policy, self.critic):
            torch.nn.utils.clip_grad_norm_(network.parameters(), s.norm)
        self._optimiser.step()

    def _adapt(self, divergence):
        """Learns slower where an update goes too far, faster where not far enough."""
        s = self.numbers
        for group in self._optimiser.param_groups:
            if divergence > 2 * s.divergence:
                group["lr"] = max(1e-5, group["lr"] / 1.5)
            elif 0 < divergence < s.divergence / 2:
                group["lr"] = min(1e-2, group["lr"] * 1.5)

    def state(self) -> dict:
        """All that goes on from here."""
        parts = {"policy": self.policy, "critic": self.critic, "optimiser": self._optimiser}
        return {name: part.state_dict() for name, part in parts.items()} | {"draw": self._draw.get_state()}

    def resume(self, state: dict) -> None:
        """Goes on from a `state`."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._draw.set_state(state["draw"].cpu())


def _log_density(mean, deviation, actions):
    scaled = (actions - mean) / deviation
    return (-0.5 * scaled.square() - deviation.log()).sum(-1)
