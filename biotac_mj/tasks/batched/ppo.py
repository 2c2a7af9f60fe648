"""Proximal policy optimisation (Schulman et al. 2017) in parallel worlds, with a critic of the true state;
before it imitation of a teacher that uses the true state, in states that the policy visits (Ross et al.
2011)."""

import dataclasses

import torch

from .policy import Network, Policy


# RSL-RL and skrl, for which `libraries` has adapters, train one policy in all worlds of an environment and
# have no imitation of a teacher; here policies of several kinds of touch share the worlds of one batch
@dataclasses.dataclass(frozen=True)
class Numbers:
    """Settings of both methods.

    Attributes:
      steps: decisions between updates. epochs, parts: of an update.
      gamma, lam: discount of a decision, and of generalised advantages. clip: of ratios of densities.
      rate: initial learning rate. During imitation it falls to the fraction `least`; PPO adapts it such that
        an update changes the policy by `divergence` [nat].
      norm: limit of gradients.
      taught: fraction of the training time with imitation, before PPO.
      lessons: limit of steps of imitation between updates, each from `several` states of the newest
        `remembered`.
      renew: stored initial states are replaced after so many times the decisions that this takes, because a
        policy would memorise the same few states.
    """

    steps: int = 8
    epochs: int = 5
    parts: int = 4
    gamma: float = 0.95
    lam: float = 0.9
    clip: float = 0.2
    rate: float = 1e-3
    least: float = 0.05
    divergence: float = 0.01
    norm: float = 1.0
    taught: float = 0.7
    lessons: int = 400
    several: int = 8192
    remembered: int = 524288
    renew: int = 5


class Lessons:
    """Readings in the newest `size` states, and the teacher's actions there.

    Args:
      size: in states. seed: of draws. device: of torch.
    """

    def __init__(self, size: int, seed: int, device: str):
        self._rows, self._size, self._count = {}, size, 0
        self._draw = torch.Generator(device).manual_seed(seed)

    def add(self, sensed: dict[str, torch.Tensor], taught: torch.Tensor) -> None:
        """Takes {name: (n, ...)} and (n, nout)."""
        index = torch.arange(self._count, self._count + len(taught), device=taught.device) % self._size
        for name, new in {**sensed, "taught": taught}.items():
            if name not in self._rows:
                self._rows[name] = new.new_empty(self._size, *new.shape[1:])
            self._rows[name][index] = new
        self._count += len(taught)

    def draw(self, count: int) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Random readings {name: (count, ...)}, and the teacher's actions (count, nout)."""
        known = min(self._count, self._size)
        device = self._rows["taught"].device
        which = torch.randint(known, (count,), generator=self._draw, device=device)
        drawn = {name: rows[which] for name, rows in self._rows.items()}
        return drawn, drawn.pop("taught")


class Learner:
    """A policy that learns.

    Args:
      nseen, nknown, nout: widths of observations, of the critic's input, and of actions.
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

    def update_statistics(
        self, seen: torch.Tensor, known: torch.Tensor, alike: torch.Tensor | None = None
    ) -> None:
        """Adds observations (n, nseen) and states (n, nknown) to the mean and variance that normalise them,
        which stay as they are while the policy learns; alike: of observations, see `Network`."""
        self.policy.update_statistics(seen, alike)
        self.critic.update_statistics(known)

    @torch.no_grad()
    def act(self, seen: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
        """Actions (n, nout) with exploration."""
        mean, explore = self.policy(seen), self.policy.explore.detach().clone()
        noise = torch.randn(mean.shape, generator=self._draw, device=self._device)
        actions = mean + explore * noise
        log = _log_density(mean, explore, actions)
        value = self.critic(known)[:, 0]
        self._kept.append([seen, known, actions, log, mean, explore.expand_as(mean), value])
        return actions

    def record(self, reward: torch.Tensor, done: torch.Tensor, over: torch.Tensor) -> None:
        """Results of the last actions (n,): reward, whether the episode ended, whether by its time limit."""
        kept = self._kept[-1]
        # what would have come after an episode's time is worth what its last state was
        kept += [reward + self.numbers.gamma * kept[6] * over, done.float()]

    def imitate(self, seen: torch.Tensor, taught: torch.Tensor, progress: float = 0.0) -> None:
        """A step towards what a teacher did, (n, nout), where (n, nseen) was seen; progress: part of such
        learning that is over, 0 to 1."""
        s = self.numbers
        for group in self._optimiser.param_groups:
            group["lr"] = s.rate * max(s.least, 1 - progress)
        self._descend(-_log_density(self.policy(seen), self.policy.explore, taught).mean())

    def update(self, known: torch.Tensor, train_policy: bool = True) -> None:
        """Learns from what was recorded.

        Args:
          known: (n, nknown) after the last decision. train_policy: the policy too, else the critic only.
        """
        s = self.numbers
        seen, known_before, actions, log, mean, explore, value, reward, done = (
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
        columns = (seen, known_before, actions, log, mean, explore, wanted, advantage)
        rows = [column.flatten(0, 1) for column in columns]
        for _ in range(s.epochs):
            order = torch.randperm(len(rows[0]), generator=self._draw, device=self._device)
            for batch in order.chunk(s.parts):
                self._improve(train_policy, *(row[batch] for row in rows))

    def _improve(self, train_policy, seen, known, actions, log, mean, explore, wanted, advantage):
        s = self.numbers
        loss = (self.critic(known)[:, 0] - wanted).square().mean()
        if train_policy:
            new_mean, new_explore = self.policy(seen), self.policy.explore
            with torch.no_grad():
                ratio = explore / new_explore
                divergence = -ratio.log() + 0.5 * (
                    ratio.square() + ((new_mean - mean) / new_explore).square() - 1
                )
                self._adapt(float(divergence.sum(-1).mean()))
            ratio = (_log_density(new_mean, new_explore, actions) - log).exp()
            gain = torch.minimum(ratio * advantage, ratio.clamp(1 - s.clip, 1 + s.clip) * advantage)
            loss = loss - gain.mean()
        self._descend(loss)

    def _descend(self, loss):
        self._optimiser.zero_grad()
        loss.backward()
        for network in (self.policy, self.critic):
            torch.nn.utils.clip_grad_norm_(network.parameters(), self.numbers.norm)
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
        """State of the training."""
        parts = {"policy": self.policy, "critic": self.critic, "optimiser": self._optimiser}
        return {name: part.state_dict() for name, part in parts.items()} | {"draw": self._draw.get_state()}

    def resume(self, state: dict) -> None:
        """Continues from a `state`."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._draw.set_state(state["draw"].cpu())


def _log_density(mean, deviation, actions):
    scaled = (actions - mean) / deviation
    return (-0.5 * scaled.square() - deviation.log()).sum(-1)
