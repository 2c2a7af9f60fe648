"""One loop for all networks: minibatches from tensors on the device, one cycle of the learning rate, the best state on validation kept."""

import contextlib
import copy

import torch

__all__ = ["cycle", "fast_products", "root_mean_square"]


@contextlib.contextmanager
def fast_products():
    """TF32 for matrix products on a GPU: good enough inside a network, not for features and components, whose small parts it would blur."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def root_mean_square(error):
    """Mean over samples of the RMS over the last axis: the paper's loss, and what its median counts."""
    return (error.square().mean(-1) + 1e-10).sqrt().mean()


def cycle(module, loss, rows, batch, steps, learning_rate, validate=None, checks=12, weight_decay=0.0, decay=None, seed=0, progress=None):
    """Trains in place.

    Args:
      module: module that is trained (parameters that need no gradient stay).
      loss: function of a tensor of rows -> scalar.
      rows: (k,) rows to draw from, on the device.
      decay: the rate falls by this factor twenty times over the training, as the paper's does every epoch; None: one cycle up and down.
      validate: function () -> float, called `checks` times; the state of its smallest value is kept at the end. None keeps the last.

    Returns:
      smallest value of validate, or None.

    Raises:
      ValueError: no rows, or a loss that is not finite.
    """
    if not len(rows):
        raise ValueError("no rows to train on: the train part of the split is empty")
    parameters = [p for p in module.parameters() if p.requires_grad]
    fused = rows.is_cuda
    optimizer = torch.optim.AdamW(parameters, learning_rate, weight_decay=weight_decay, fused=fused)
    if decay is None:
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2 * learning_rate, total_steps=steps, pct_start=0.15)
    else:
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: decay ** (20 * step / steps))
    generator = torch.Generator(device=rows.device).manual_seed(seed)
    best, state = None, None
    module.train()
    every = max(1, steps // checks)
    for step in range(steps):
        index = torch.randint(len(rows), (min(batch, len(rows)),), generator=generator, device=rows.device)
        value = loss(rows[index])
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        schedule.step()
        if (step + 1) % every == 0 or step + 1 == steps:
            if not torch.isfinite(value):
                raise ValueError(
                    f"the loss is {float(value)} at step {step}: look for values that are not finite in the data, or lower the rate"
                )
            if validate is not None:
                module.eval()
                with torch.no_grad():
                    now = float(validate())
                module.train()
                if best is None or now < best:
                    best, state = now, copy.deepcopy(module.state_dict())
        if progress:
            progress()
    if state is not None:
        module.load_state_dict(state)
    module.eval()
    return best
