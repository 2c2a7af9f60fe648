"""A finger's path shaped by gradient: it strokes 3 mm across a ball that stays where it is, and is to press
with 1 N all the way, of which nobody has told it the heights. Needs the extra `learning` (PyTorch); half a
minute: python examples/shape_a_path.py

The gradient goes through rubber, liquid and friction of all steps at once: what a step does to the later
ones, by the liquid and by where the skin sticks, is in it."""

import torch

from biotac_mj import differentiable
from biotac_mj.geometry import load_skin

DOWN, ALONG = 3, 6  # steps
FORCE, STROKE = 1.0, 3e-3  # [N], [m]
RADIUS = 6e-3  # of the ball [m]
TOUCH = torch.tensor([-11e-3, -6.6e-3 - RADIUS, 0.0], dtype=torch.float64)  # its centre, under the pad [m]


def wanted() -> torch.Tensor:
    """(DOWN + ALONG,) force of each step [N]."""
    return FORCE * torch.cat([torch.arange(1, DOWN + 1) / DOWN, torch.ones(ALONG)]).double()


def stroke(skin: differentiable.Skin, heights: torch.Tensor) -> tuple[torch.Tensor, differentiable.Pressed]:
    """Force against the finger's -y in each step [N], and the press; heights: (n,) of the finger [mm]."""
    n = len(heights)
    along = STROKE * (torch.arange(n).double() - DOWN + 1).clamp(min=0) / ALONG
    finger = torch.stack([along - STROKE / 2, 1e-3 * heights, torch.zeros(n).double()], 1)
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(n, 4)
    pressed = differentiable.press(skin, TOUCH.expand(n, 1, 3), upright[:, None], finger, upright)
    return -pressed.wrench[:, 0, 1], pressed


def main(skin: str = "coarse", evaluations: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    """Forces (n,) [N] of the path that the search began with, and of the one that it found."""
    geometry = load_skin(skin)
    ball = differentiable.Skin(geometry, types=["sphere"], sizes=[[RADIUS]])
    heights = torch.zeros(DOWN + ALONG, dtype=torch.float64)
    heights[:DOWN] = 0.1 * torch.arange(DOWN - 1, -1, -1)
    heights.requires_grad_()
    search = torch.optim.LBFGS(
        [heights], max_iter=evaluations, max_eval=evaluations, line_search_fn="strong_wolfe"
    )
    seen = []

    def loss():
        search.zero_grad()
        force, pressed = stroke(ball, heights)
        off = ((force - wanted()) ** 2).sum()
        off.backward()
        seen.append(force.detach())
        missed = (off.detach() / len(heights)).sqrt()
        print(f"{len(seen):2d}: forces miss by {missed:.4f} N, {pressed.counts.lost} steps without a balance")
        return off

    search.step(loss)
    after = stroke(ball, heights.detach())[0]
    print("forces before [N]:", seen[0].numpy().round(3))
    print("forces after  [N]:", after.numpy().round(3))
    print("heights [mm]:", heights.detach().numpy().round(3))
    return seen[0], after


if __name__ == "__main__":
    main()
