"""Training loop of all networks: minibatches from tensors on the device, one cycle of the learning rate, the
best validation state is kept.

These networks are small: on a GPU a step is mostly launch overhead, so it is captured once as a CUDA graph
and replayed.
"""

import contextlib
import copy
import dataclasses
from collections.abc import Callable, Iterator

import torch
from torch.optim.lr_scheduler import LambdaLR, OneCycleLR

_CHECKS = 12  # validations in a training
_WARM = 5  # warm-up steps before the capture


@contextlib.contextmanager
def fast_products() -> Iterator[None]:
    """TF32 for matrix products on a GPU: accurate enough inside a network, not for features and components,
    whose small values it would lose."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def root_mean_square(error: torch.Tensor) -> torch.Tensor:
    """Mean over samples of the RMS over the last axis: the paper's loss and metric."""
    return (error.square().mean(-1) + 1e-10).sqrt().mean()


@dataclasses.dataclass(frozen=True)
class TrainingOptions:
    """Settings of a training.

    Attributes:
      batch: rows per step. learning_rate: of AdamW, with its weight_decay. seed: of the batches.
      decay: the rate falls by this factor twenty times over the training, as the paper's does every epoch;
        None: one cycle, up to twice the rate in the first 15 % of the training, then to zero (Smith, 2018).
      graph: on a GPU, replay the steps as a CUDA graph; the loss must then not synchronise with the host.
    """

    batch: int
    steps: int
    learning_rate: float
    weight_decay: float = 0.0
    decay: float | None = None
    seed: int = 0
    graph: bool = True


def train(
    module: torch.nn.Module,
    loss: Callable[[torch.Tensor], torch.Tensor],
    rows: torch.Tensor,
    options: TrainingOptions,
    validate: Callable[[], float] | None = None,
    progress: Callable[[int], object] | None = None,
    curve: list | None = None,
) -> float | None:
    """Trains a module in place.

    Args:
      module: parameters without gradient stay fixed.
      loss: tensor of rows -> scalar.
      rows: (k,) rows to draw from, on the device.
      validate: () -> float, called twelve times; the state with its smallest value is restored at the end.
        None keeps the last.
      progress: called with 1 at each step. curve: gets [step, value] of each validation.

    Returns:
      smallest value of validate, or None.

    Raises:
      ValueError: no rows, or a loss that is not finite.
    """
    if not len(rows):
        raise ValueError("no rows to train on: the train part of the split is empty")
    parameters = [p for p in module.parameters() if p.requires_grad]
    cuda = rows.is_cuda
    steps = options.steps
    # on the device, where a replayed step reads it
    rate = torch.tensor(float(options.learning_rate), device=rows.device)
    optimizer = torch.optim.AdamW(
        parameters, rate, weight_decay=options.weight_decay, fused=cuda, capturable=cuda
    )
    schedule = _schedule(optimizer, options.learning_rate, steps, options.decay)
    generator = torch.Generator(device=rows.device).manual_seed(options.seed)
    chosen = torch.zeros(min(options.batch, len(rows)), dtype=rows.dtype, device=rows.device)
    best, state = None, None
    module.train()
    every = max(1, steps // _CHECKS)

    def one():
        value = loss(chosen)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        return value

    replay = None
    for step in range(steps):
        chosen.copy_(rows[torch.randint(len(rows), chosen.shape, generator=generator, device=rows.device)])
        if replay:
            replay.replay()
        elif cuda and options.graph and step >= _WARM:
            replay, value = _record(one)
            replay.replay()
        else:
            value = _on_side_stream(one) if cuda and options.graph else one()
        schedule.step()
        if progress:
            progress(1)
        if (step + 1) % every == 0 or step + 1 == steps:
            if not torch.isfinite(value):
                raise ValueError(
                    f"the loss is {float(value)} at step {step}: "
                    "look for values that are not finite in the data, or lower the rate"
                )
            if validate is not None:
                module.eval()
                with torch.no_grad():
                    now = float(validate())
                module.train()
                if curve is not None:
                    curve.append([step + 1, now])
                if best is None or now < best:
                    best, state = now, copy.deepcopy(module.state_dict())
    if state is not None:
        module.load_state_dict(state)
    module.eval()
    return best


def _schedule(optimizer, rate, steps, decay):
    """Schedule of the learning rate, see `TrainingOptions`."""
    if decay is None:
        return OneCycleLR(optimizer, 2 * rate, steps, pct_start=0.15, cycle_momentum=False)
    return LambdaLR(optimizer, lambda step: decay ** (20 * step / steps))


def _on_side_stream(one):
    """A step on a separate stream, as PyTorch requires for warm-up steps before a capture."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        value = one()
    torch.cuda.current_stream().wait_stream(stream)
    return value


def _record(one):
    """A step as a CUDA graph, and the tensor of its loss."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        value = one()
    return graph, value
